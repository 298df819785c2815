"""The steps that bring what parametrises the geometry to where the joint stage starts."""

from __future__ import annotations

from ..bookkeeping.observer import Preview
from .joint import JointStage


class FieldFitting:
    """Fits the networks of a joint stage's geometry to the fields that its subject holds."""

    def __init__(self, joint: JointStage):
        self.joint, self.geometry = joint, joint.geometry

    def step(self, iteration: int) -> dict[str, float]:
        """One step; returns the losses."""
        return self.geometry.fit_step(iteration)

    def preview(self) -> Preview:
        """The mesh to start from."""
        return self.joint.preview()
