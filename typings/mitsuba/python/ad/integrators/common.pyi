from typing import Any

from mitsuba import Integrator

class ADIntegrator(Integrator):
    max_depth: int
    rr_depth: int
    def aov_names(self) -> list[str]: ...
    def prepare(self, sensor: Any, seed: int = 0, spp: int = 0, aovs: list[str] = ...) -> Any: ...
    def sample_rays(self, scene: Any, sensor: Any, sampler: Any) -> Any: ...
    def render(
        self,
        scene: Any,
        sensor: Any = 0,
        seed: int = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> Any: ...
    @staticmethod
    def _splat_to_block(*args: Any, **kwargs: Any) -> None: ...
