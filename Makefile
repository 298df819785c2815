# make fit      set everything up and reconstruct SCENE (default scenes/tshirt.xml) into OUT
# make generate set everything up and sample garments from the model in the package into GARMENTS
# make test     set everything up, check the style and the types, and run the tests
# make regress  fit every scene with default settings and compare with the stored results
# make scenes   rebuild the scenes from code
# make docs     build the documentation into build/site
# make fuzz     try damaged inputs of every kind, for ten minutes

SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
MAKEFLAGS += --no-print-directory

SCENE ?= scenes/tshirt.xml
GARMENTS ?= out/garments
OUT ?= out/$(basename $(notdir $(SCENE)))
VENV ?= .venv
PY := $(VENV)/bin/python

# BLAS threads and Dr.Jit's thread pool fight for the same cores.
export OPENBLAS_NUM_THREADS ?= 1
export PIP_DISABLE_PIP_VERSION_CHECK := 1
export NO_MKDOCS_2_WARNING := 1

.PHONY: help fit generate test regress scenes docs fuzz clean

help:
	@sed -n 's/^# //p' Makefile | head -7

fit: $(VENV)/.llvm
	@$(PY) -m gshell_mi.fit $(SCENE) -o $(OUT) --overwrite $(ARGS)

generate: $(VENV)/.generate $(VENV)/.llvm
	@$(PY) -m gshell_mi.generate -o $(GARMENTS) $(ARGS)

test: $(VENV)/.test $(VENV)/.llvm
	@$(PY) -m ruff check --quiet .
	@$(PY) -m ruff format --check --quiet . || { echo "Run $(PY) -m ruff format ."; exit 1; }
	@$(PY) -m basedpyright --pythonpath $(PY)
	@$(PY) -m pytest $(ARGS)

regress: $(VENV)/.test $(VENV)/.llvm
	@$(PY) -m pytest tests/regression/fits.py -rs -s $(ARGS)

scenes: $(VENV)/.test $(VENV)/.llvm
	@$(PY) pipelines/make_scenes.py $(ARGS)

docs: $(VENV)/.docs
	@$(PY) -m mkdocs build --strict $(ARGS)

fuzz: $(VENV)/.test $(VENV)/.llvm
	@$(PY) pipelines/fuzz.py $(ARGS)

clean:
	rm -rf $(VENV) build *.egg-info

# Stamps: what a folder of pip's cannot tell make is done.
$(VENV)/.package: $(PY) pyproject.toml
	@echo "Installing gshell_mi into $(VENV) ..."
	@$(PY) -m pip install --quiet --editable .
	@touch $@

$(VENV)/.test: $(VENV)/.package
	@echo "Installing the tests' tools into $(VENV) ..."
	@$(PY) -m pip install --quiet --editable '.[test]'
	@touch $@

# PyTorch's own index has builds without CUDA, which are a tenth of the size.
$(VENV)/.generate: $(VENV)/.package
	@echo "Installing PyTorch into $(VENV) ..."
	@$(PY) -c 'import torch' 2>/dev/null || \
	    $(PY) -m pip install --quiet torch --index-url https://download.pytorch.org/whl/cpu || \
	    $(PY) -m pip install --quiet torch
	@$(PY) -m pip install --quiet --editable '.[generate]'
	@touch $@

$(VENV)/.docs: $(VENV)/.package
	@echo "Installing the documentation's tools into $(VENV) ..."
	@$(PY) -m pip install --quiet --editable '.[docs]'
	@touch $@

# Dr.Jit's wheels leave two libraries to the system: libatomic, and LLVM, which they load when first used.
$(VENV)/.llvm: $(VENV)/.package
	@$(PY) -c 'import drjit' 2>/dev/null || .ci/apt-install libatomic1
	@$(PY) -m gshell_mi.doctor --llvm 2>/dev/null || .ci/apt-install libllvm 2>/dev/null || \
	    if $(PY) -m gshell_mi.doctor --llvm 2>&1 | grep -q mitsuba==; then \
	        echo "The LLVM found needs Mitsuba 3.9.0: installing it ..."; \
	        $(PY) -m pip install --quiet mitsuba==3.9.0; \
	    else \
	        .ci/apt-install libllvm; \
	    fi
	@$(PY) -m gshell_mi.doctor --llvm
	@touch $@

# A name on the path may be a shim that does not run, so candidates are tried.
$(PY):
	@for python in $(PYTHON) python3.12 python3.11 python3 python; do \
	    if $$python -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12))' 2>/dev/null; then \
	        echo "Creating $(VENV) with $$($$python --version) ..."; \
	        $$python -m venv $(VENV) >/dev/null && exit 0; \
	        rm -rf $(VENV); \
	        .ci/apt-install "$$($$python -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])')"; \
	        $$python -m venv $(VENV) && exit 0; \
	        exit 2; \
	    fi; \
	done; \
	echo "gshell_mi needs Python 3.11 or 3.12, and none was found: install one (Debian, Ubuntu: python3 python3-venv) or name it with make PYTHON=/path/to/python" >&2; \
	exit 2
