"""The reparameterised path integrator ``gshell_path``."""

import mitsuba as mi
from mitsuba.python.ad.integrators.prb import PRBIntegrator


class GShellPathIntegrator(PRBIntegrator):
    """Path integrator; derivatives of visibility are not yet included."""


mi.register_integrator("gshell_path", lambda props: GShellPathIntegrator(props))
