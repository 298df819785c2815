"""The one way in for scenes from XML files, which are data that anybody may have written.

Mitsuba looks for plugins, which are native code, in every folder of its resource path, and puts the folder of
a scene and whatever ``<path>`` names in front of it. So the file is parsed first, by Mitsuba, which loads
nothing yet; the types that it names are held against those that exist; and the scene is then made with
Mitsuba's own folder in front. See docs/security.md.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from xml.parsers import expat

import mitsuba as mi

from .compat import MITSUBA_INTEGRATORS, mitsuba_folder, trust_only_own_plugins
from .environment_maps import read_environment_map
from .errors import UserError, first_line, last_line
from .float_images import check_for_mitsuba, is_exr, read_float_image

#: Python plugins of this package.
OWN_PLUGINS = ("gshell", "gshell_path", "gshell_mask")
#: Mitsuba's parser is recursive, and some thousand levels overflow its stack.
_DEEPEST = 100
#: As many levels of ``<include>`` as Mitsuba follows.
_MOST_INCLUDES = 15


def load_scene(path: str | Path, *, name: str = "Scene") -> mi.Scene:
    """Loads a Mitsuba scene file that nobody vouches for.

    Args:
        path: the XML file.
        name: what it is called in messages.

    Raises:
        UserError: it is missing, no XML, nested too deeply, names a plugin that does not exist, refers to an
            unusable image, or Mitsuba refuses it.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"{name} '{path}' does not exist; check the path.")
    try:
        _check_document(path, path.parent, {}, 0)
        with _resolving_beside(path):
            config = mi.parser.ParserConfig(mi.variant())
            state = mi.parser.parse_file(config, str(path))
            trust_only_own_plugins()  # <path> has put its folders in front
            mi.parser.transform_all(config, state)
            for node in state.nodes:
                _check_plugin(node.props.plugin_name())
                _check_images(node.props)
            scene = mi.parser.instantiate(config, state)
    except UserError:
        raise
    except Exception as error:
        raise UserError(
            f"{name} '{path}' cannot be loaded by Mitsuba: {_reason(error)}; {_remedy(path)}."
        ) from error
    scene = scene[0] if isinstance(scene, list) and len(scene) == 1 else scene
    if not isinstance(scene, mi.Scene):
        raise UserError(f"{name} '{path}' holds no <scene>; give a Mitsuba scene file.")
    return scene


def is_scene_file(path: Path) -> bool:
    """Whether an XML file's outermost element is ``<scene>``, as Mitsuba's is."""
    found = []

    def started(tag: str, attributes: dict[str, str]) -> None:
        found.append(tag)
        raise _Enough

    try:
        _parse(path, started)
    except (_Enough, expat.ExpatError, OSError):
        pass
    return found[:1] == ["scene"]


class _Enough(Exception):
    """What is looked for has been found."""


def _parse(
    path: Path, started: Callable[[str, dict[str, str]], None], ended: Callable[[str], None] | None = None
) -> None:
    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = started, ended
    parser.Parse(path.read_bytes(), True)


def _check_document(path: Path, root: Path, defaults: dict[str, str], level: int) -> None:
    """Refuses what would overflow the stack of Mitsuba's parser, in a file and those that it includes."""
    depth, included = 0, []

    def started(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > _DEEPEST:
            raise ValueError(f"'{path}' is nested more than {_DEEPEST} elements deep, which is no scene")
        if tag == "default" and "name" in attributes:
            defaults.setdefault(attributes["name"], attributes.get("value", ""))
        if tag == "include" and "filename" in attributes:
            included.append(substituted(attributes["filename"], defaults))

    def ended(tag: str) -> None:
        nonlocal depth
        depth -= 1

    try:
        _parse(path, started, ended)
    except expat.ExpatError as error:
        raise ValueError(f"'{path}' is no XML file ({error})") from error
    for name in included:
        found = next((folder / name for folder in (path.parent, root) if (folder / name).is_file()), None)
        if found is not None:
            if level >= _MOST_INCLUDES:
                raise ValueError(f"'{path}' is included {level} files deep; a file may not include itself")
            _check_document(found, root, defaults, level + 1)


def substituted(text: str, defaults: dict[str, str]) -> str:
    """A value with what its ``$`` parameters stand for, as Mitsuba reads it: longer names first."""
    for name in sorted(defaults, key=len, reverse=True):
        text = text.replace("$" + name, defaults[name])
    return text


@contextmanager
def _resolving_beside(path: Path) -> Iterator[None]:
    """Relative names mean files beside ``path``; afterwards, what they meant before."""
    before = mi.file_resolver()
    resolver = mi.FileResolver(before)
    resolver.prepend(str(path.resolve().parent))
    mi.set_file_resolver(resolver)
    trust_only_own_plugins()
    try:
        yield
    finally:
        mi.set_file_resolver(before)


def _check_plugin(name: str) -> None:
    # Names that are registered in Python for this variant are found without a search for a file.
    registered = () if (mi.variant() or "").startswith("scalar") else (*OWN_PLUGINS, *MITSUBA_INTEGRATORS)
    native = re.fullmatch(r"\w+", name) and any((mitsuba_folder() / "plugins").glob(f"{name}.*"))
    if name not in ("scene", *registered) and not native:
        raise ValueError(
            f"it names a plugin '{name}', which neither Mitsuba nor gshell_mi has; scenes may "
            f"not bring code of their own"
        )


def _check_images(props: mi.Properties) -> None:
    """Refuses images that would crash Mitsuba's reader or poison every pixel."""
    if props.plugin_name() not in ("envmap", "bitmap") or "filename" not in props:
        return
    path = Path(str(mi.file_resolver().resolve(str(props["filename"]))))
    if not path.is_file():
        return  # Mitsuba says so
    if props.plugin_name() == "envmap":
        read_environment_map(path, "Environment map")
    if is_exr(path):
        if not _is_plain_exr(path):
            raise ValueError(
                f"image '{path}' has a data window other than its display window, which Mitsuba "
                f"cannot read; write it without a border or crop"
            )
        if props.plugin_name() == "envmap":
            return  # it has just been read
    try:
        (read_float_image if is_exr(path) else check_for_mitsuba)(path)
    except Exception as error:
        raise ValueError(
            f"image '{path}' cannot be read ({error}); write it again, as PNG or OpenEXR"
        ) from error


def _is_plain_exr(path: Path) -> bool:
    import OpenEXR

    windows = OpenEXR.File(str(path), header_only=True).parts[0].header
    return all((windows["dataWindow"][end] == windows["displayWindow"][end]).all() for end in (0, 1))


def _remedy(path: Path) -> str:
    return "correct it" if path.suffix.lower() == ".xml" else "a scene is an XML file, give one"


def _reason(error: Exception) -> str:
    """The one line of Mitsuba's message that says what is wrong."""
    # A plugin's own complaint comes below the traceback that Mitsuba puts into its message.
    _, found, complaint = last_line(error).partition(f"{UserError.__name__}: ")
    return (complaint if found else first_line(error)).rstrip(". ")
