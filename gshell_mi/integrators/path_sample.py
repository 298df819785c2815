"""What the integrators of this package return for one camera ray."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi


@dataclass
class PathSample:
    """Radiance, coverage and arbitrary output variables of a camera ray."""

    value: mi.Spectrum  #: radiance
    alpha: mi.Float  #: coverage
    aovs: list[mi.Float]  #: one per output variable
