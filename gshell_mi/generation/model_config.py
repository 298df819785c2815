"""What a model is, apart from its weights."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ..errors import UserError
from ..json_files import read_json_object

#: Names of the models.
MODELS = ("blocks", "unet")
#: Width, depth and heads of the transformer; base width of the U-Net.
SIZES: dict[str, dict[str, int]] = {
    "XS": {"width": 64, "depth": 2, "heads": 2, "channels": 8},
    "S": {"width": 192, "depth": 6, "heads": 6, "channels": 16},
    "M": {"width": 384, "depth": 12, "heads": 6, "channels": 32},
    "L": {"width": 768, "depth": 16, "heads": 12, "channels": 64},
}


@dataclass(frozen=True)
class ModelConfig:
    """Written into ``model.json``."""

    model: str
    """``blocks`` or ``unet``."""
    size: str
    """One of ``SIZES``."""
    side: int
    """Vertices per side of the grid."""
    classes: tuple[str, ...]
    components: int = 128
    """Principal components that a block keeps."""

    @property
    def shape(self) -> dict[str, int]:
        return SIZES[self.size]

    def to_dict(self) -> dict[str, Any]:
        return asdict(self) | {"classes": list(self.classes)}

    @classmethod
    def read(cls, path: Path) -> ModelConfig:
        """From a ``model.json``.

        Raises:
            UserError: it is missing, damaged or of a model that this version does not know.
        """
        try:
            found = read_json_object(path)["config"]
            config = cls(str(found["model"]), str(found["size"]), int(found["side"]),
                         tuple(str(name) for name in found["classes"]), int(found["components"]))
        except FileNotFoundError:
            raise UserError(f"'{path.parent}' holds no model; train one with python -m "
                            f"gshell_mi.train.") from None
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UserError(f"'{path}' is damaged ({error}); train the model again.") from error
        if config.model not in MODELS or config.size not in SIZES:
            raise UserError(f"'{path}' describes a model of another kind ('{config.model}', size "
                            f"'{config.size}'); it belongs to another version of gshell_mi.")
        if config.side % 8 or not 16 <= config.side <= 256 or not 1 <= config.components <= 1024:
            raise UserError(f"'{path}' describes a grid that no model here has; train the model again.")
        return config
