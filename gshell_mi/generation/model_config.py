"""What a model is, apart from its weights."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ..errors import UserError
from ..json_files import read_json_object

#: Folder of the model of garments that comes with the package.
SHIPPED = Path(__file__).parent / "shipped" / "garments"
#: Names of the models.
MODELS = ("shape", "latent", "unet")


@dataclass(frozen=True)
class Size:
    """How large a model is."""

    width: int
    """Of the transformer."""
    depth: int
    heads: int
    latents: int
    """Numbers per block of 8^3 vertices."""
    features: tuple[int, int, int]
    """Of the autoencoder, per 2^3, 4^3 and 8^3 vertices."""
    channels: int
    """Base width of the U-Net."""
    components: int
    """Of whole shapes."""
    perceptron: int
    """Width of the perceptron over these."""
    layers: int


SIZES = {
    "XS": Size(64, 2, 2, 8, (16, 16, 16), 8, 16, 64, 2),
    "S": Size(192, 6, 6, 16, (32, 64, 96), 16, 120, 384, 4),
    "M": Size(384, 12, 6, 16, (48, 96, 160), 32, 256, 768, 6),
    "L": Size(768, 16, 12, 16, (64, 128, 256), 64, 512, 1024, 8),
}


@dataclass(frozen=True)
class ModelConfig:
    """Written into ``model.json``."""

    model: str
    """One of ``MODELS``."""
    size: str
    """One of ``SIZES``."""
    side: int
    """Vertices per side of the grid."""
    classes: tuple[str, ...]

    @property
    def shape(self) -> Size:
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
            config = cls(
                str(found["model"]),
                str(found["size"]),
                int(found["side"]),
                tuple(str(name) for name in found["classes"]),
            )
        except FileNotFoundError:
            raise UserError(
                f"'{path.parent}' holds no model; train one with python -m gshell_mi.train."
            ) from None
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UserError(f"'{path}' is damaged ({error}); train the model again.") from error
        if config.model not in MODELS or config.size not in SIZES:
            raise UserError(
                f"'{path}' describes a model of another kind ('{config.model}', size "
                f"'{config.size}'); it belongs to another version of gshell_mi."
            )
        if config.side % 8 or not 16 <= config.side <= 256:
            raise UserError(f"'{path}' describes a grid that no model here has; train the model again.")
        return config
