"""The pages of the documentation that are not files in ``docs``: a hook of MkDocs, used by ``make docs``.

README.md, CONTRIBUTING.md and CHANGELOG.md become pages, and every public module of the library is described
on one made from its docstrings.
"""

from __future__ import annotations

import ast
import json
import re
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files

ROOT = Path(__file__).parents[1]

#: Pages of the repository's own files.
OWN_FILES = {"index.md": "README.md", "contributing.md": "CONTRIBUTING.md", "changelog.md": "CHANGELOG.md"}

#: Pages of the library: title, what is said first, and the modules and packages that each describes.
LIBRARY = {
    "lattice": ("Lattices", "Where the fields live.", ["lattice", "arrays", "bricks"]),
    "fields": (
        "Fields",
        "Signed distances on a lattice, and how they begin.",
        ["fields", "template", "parametrisation", "activations"],
    ),
    "extraction": ("Extraction", "From fields to meshes, with derivatives.", ["extraction"]),
    "mesh": (
        "Meshes",
        "From meshes back to fields; what meshes are like.",
        [
            "conversion",
            "mesh_files",
            "topology",
            "triangles",
            "visibility",
            "coincident",
            "subdivision",
            "diagnostics",
        ],
    ),
    "shape": ("The shape plugin", "`gshell` for Mitsuba.", ["shape", "plugins", "compat"]),
    "integrators": (
        "Integrators",
        "`gshell_path` and `gshell_mask` for Mitsuba.",
        ["integrators.gshell_path", "integrators.gshell_mask", "integrators"],
    ),
    "capture": ("Capture", "From photographs to fit scenes.", ["capture"]),
    "scene": (
        "Fit scenes",
        "What a fit starts from, and files that anybody may have written.",
        [
            "scene",
            "targets",
            "views",
            "pixels",
            "packed_pixels",
            "scene_files",
            "scene_inputs",
            "images",
            "float_images",
            "integer_images",
            "plain_float_images",
            "environment_maps",
            "json_files",
        ],
    ),
    "fit": ("Fit", "From scenes to surfaces, materials and light.", ["fit", "bounds", "preview"]),
    "radiance": (
        "Radiance and cameras",
        "What images say of a surface before it has a material, and of where they were taken.",
        ["radiance", "calibration"],
    ),
    "losses": (
        "Losses, material, light",
        "What a fit minimises, and what it changes beside the surface.",
        [
            "losses",
            "means",
            "material",
            "light",
            "extras",
            "schedules",
            "outliers",
            "tempered_adam",
            "optimizer_arrays",
        ],
    ),
    "evaluation": ("Evaluation", "How good a result is.", ["evaluation", "compare"]),
    "export": (
        "Export",
        "What a fit leaves behind, and what can be made of it.",
        ["export", "turntable", "report", "viewer"],
    ),
    "generation": (
        "Generation",
        "Data sets of surfaces, models of them, and new surfaces.",
        ["generation", "dataset", "train", "generate"],
    ),
    "batch": ("Many jobs", "Fits by the thousand.", ["batch"]),
    "commands": (
        "Commands and machine",
        "What the commands share, and what the machine can do.",
        [
            "command_line",
            "streams",
            "interrupt",
            "lifetime",
            "errors",
            "files",
            "own_folder",
            "memory",
            "kernel_cache",
            "timing",
            "wording",
            "progress",
            "bars",
            "doctor",
        ],
    ),
}

#: Packages of which only the modules right inside are described: what lies deeper may change.
_SHALLOW = {"fit"}


def public_modules(folder: Path = ROOT / "gshell_mi") -> list[str]:
    """Dotted names, without ``gshell_mi``, of the modules and packages that are described."""
    found = []
    for path in sorted(folder.rglob("*.py")):
        parts = path.relative_to(folder).with_suffix("").parts
        parts = parts[:-1] if parts[-1] == "__init__" else parts
        hidden = not parts or any(part.startswith("_") for part in parts)
        if not hidden and (parts[0] not in _SHALLOW or path.parent == folder / parts[0]):
            found.append(".".join(parts))
    return found


def modules_of(page: str) -> list[str]:
    """The modules that a page of the library describes: of each package first itself, then its modules."""
    modules = public_modules()
    found = [
        module
        for room in LIBRARY[page][2]
        for module in modules
        if module == room or module.startswith(f"{room}.")
    ]
    return list(dict.fromkeys(found))


def exports(package: Path) -> list[str]:
    """The names that a package imports from its modules, but those that a module of it has, too."""
    names = [
        name.name
        for statement in ast.parse((package / "__init__.py").read_text()).body
        if isinstance(statement, ast.ImportFrom) and statement.level
        for name in statement.names
    ]
    return [name for name in names if not (package / f"{name}.py").exists()]


def library_page(page: str) -> str:
    """The Markdown of a page of the library: what a package exports stands there, and not at its modules."""
    title, first, _ = LIBRARY[page]
    blocks = [f"# {title}", first]
    for module in modules_of(page):
        blocks.append(f"::: gshell_mi.{module}")
        package = ROOT / "gshell_mi" / module.split(".")[0]
        if "." in module and (exported := exports(package)):
            filters = ["!^_", *(f"!^{name}$" for name in exported)]
            blocks[-1] += f"\n    options:\n      filters: {json.dumps(filters)}"
    return "\n\n".join(blocks) + "\n"


def own_page(name: str) -> str:
    """The Markdown of a file of the repository, with its links as they are from within ``docs``."""
    text = (ROOT / OWN_FILES[name]).read_text()
    for page, source in OWN_FILES.items():
        text = text.replace(f"]({source}", f"]({page}")
    return re.sub(r"\]\(docs/", "](", text)


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Puts the pages of the library into the navigation."""
    section = next(entry["Library"] for entry in config.nav or [] if "Library" in entry)
    section.extend({title: f"api/{page}.md"} for page, (title, _, _) in LIBRARY.items())
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the pages."""
    from mkdocs.structure.files import File

    for name in OWN_FILES:
        files.append(File.generated(config, name, content=own_page(name)))
    for page in LIBRARY:
        files.append(File.generated(config, f"api/{page}.md", content=library_page(page)))
    return files
