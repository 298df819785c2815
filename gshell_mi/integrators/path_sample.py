"""What the integrators of this package return for one camera ray."""

from dataclasses import dataclass


@dataclass
class PathSample:
    """Radiance, coverage and arbitrary output variables of a camera ray."""

    value: object   #: ``Spectrum``: radiance
    alpha: object   #: ``Float``: coverage
    aovs: object    #: list of ``Float``
