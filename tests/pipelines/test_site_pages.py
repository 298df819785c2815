"""The documentation's site leaves no page and no public module out."""

import importlib.util
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def site():
    spec = importlib.util.spec_from_file_location("site_pages", ROOT / "pipelines" / "site_pages.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def pages_in_navigation() -> list[str]:
    return re.findall(r"^ +- [^:\n]+: (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.M)


def test_every_page_is_in_the_navigation(site):
    written = {page.relative_to(ROOT / "docs").as_posix() for page in (ROOT / "docs").rglob("*.md")}
    listed = pages_in_navigation()
    assert len(listed) == len(set(listed))
    assert set(listed) == written | set(site.OWN_FILES)


def test_every_public_module_is_on_one_page(site):
    described = [module for page in site.LIBRARY for module in site.modules_of(page)]
    assert sorted(described) == sorted(site.public_modules())
    assert "fit.config" in described and "extraction.surface_mesh" in described


def test_hidden_modules_and_stages_of_the_fit_are_left_out(site, tmp_path):
    for path in (
        "a.py",
        "_hidden.py",
        "room/__init__.py",
        "room/b.py",
        "room/__main__.py",
        "fit/__init__.py",
        "fit/config.py",
        "fit/stage/__init__.py",
        "fit/stage/c.py",
    ):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).touch()
    assert site.public_modules(tmp_path) == ["a", "fit", "fit.config", "room", "room.b"]


def test_links_of_the_repositorys_files_lead_to_pages(site):
    for name in site.OWN_FILES:
        for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", site.own_page(name)):
            assert target in site.OWN_FILES or (ROOT / "docs" / target).exists(), target
