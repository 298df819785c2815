
from mitsuba import Integrator

class ADIntegrator(Integrator):
    max_depth: int
    rr_depth: int
