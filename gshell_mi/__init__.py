"""G-Shell inverse rendering in Mitsuba 3: photographs in; open meshes, materials and light out."""

from .errors import UserError
from .plugins import register_on_variant_change

__version__ = "0.1.0"
__all__ = ["UserError", "__version__"]

register_on_variant_change()
