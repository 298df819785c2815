"""The texture ``gshell_color``: a base colour finer than the mesh."""

import mitsuba as mi

from .color_detail import ColorDetail


class SurfaceColor(mi.Texture):
    """A texture: the mesh attribute ``vertex_color`` with a ``ColorDetail``.

    Attributes:
        detail: the ``ColorDetail``; ``None`` for the attribute alone. Its values are the parameter ``detail``
            of ``mi.traverse``.
    """

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        self.detail: ColorDetail | None = None

    def traverse(self, callback):
        if self.detail:
            callback.put("detail", self.detail.values, mi.ParamFlags.Differentiable)

    def eval(self, si, active=True):
        color = mi.Color3f(si.shape.eval_attribute_3("vertex_color", si, active))
        return self.detail.color(color, si.p, active) if self.detail else color

    def eval_3(self, si, active=True):
        return self.eval(si, active)

    def eval_1(self, si, active=True):
        return mi.luminance(self.eval(si, active))

    def is_spatially_varying(self):
        return True

    def to_string(self):
        return "SurfaceColor[]"


mi.register_texture("gshell_color", SurfaceColor)
