from typing import Any

from mitsuba import Integrator

class ADIntegrator(Integrator):
    max_depth: int
    rr_depth: int
    def aov_names(self) -> list[str]: ...
    def prepare(self, sensor: Any, seed: int = 0, spp: int = 0, aovs: list[str] = ...) -> Any: ...
