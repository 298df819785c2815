"""G-Shell inverse rendering in Mitsuba 3: photographs in; open meshes, materials and light out.

The rooms, in the order in which data flows through them:

- ``lattice``, ``fields``, ``extraction``: from signed distances on a lattice, or on its blocks around the
  surface, to a triangle mesh
- ``conversion``: from a triangle mesh back to such distances
- ``shape``: the same as a Mitsuba shape, ``{"type": "gshell"}``
- ``integrators``: rendering with right derivatives, ``{"type": "gshell_path"}`` and ``gshell_mask``
- ``capture``: photographs or a video become a fit scene, ``python -m gshell_mi.capture``
- ``targets``, ``views``, ``scene``: what a fit starts from
- ``parametrisation``: what an optimiser changes in place of the lattice fields
- ``template``: what can be done to a watertight surface and the mSDF that cuts it
- ``radiance``, ``calibration``: what images say of a surface before it has a material, and of the cameras
- ``activations``, ``losses``, ``material``, ``light``, ``fit``: the optimisation, ``python -m gshell_mi.fit``
- ``extras``: losses and parametrisations that it knows by name and leaves out by default
- ``viewer``: a look at it while it runs, ``--viewer``
- ``images``, ``topology``, ``export``, ``turntable``, ``report``: what it leaves behind
- ``evaluation``, ``compare``: how good it is
- ``generation``: models that learn such surfaces and make new ones; ``dataset``, ``train``, ``generate``
- ``batch``: many commands, on many machines
- ``scene_files``, ``scene_inputs``, ``float_images``, ``environment_maps``, ``mesh_files``, ``json_files``:
  files that anybody may have written, read with care
- ``command_line``, ``streams``, ``interrupt``, ``errors``, ``files``, ``own_folder``, ``lifetime``,
  ``memory``: what the commands share; ``doctor``: whether this machine can run it all
- ``arrays``: names of Dr.Jit arrays in annotations
- ``compat``, ``plugins``: what depends on Mitsuba's version, and how its plugins are registered

Importing the package sets no variant; its plugins register for the variant in use and for every later one.

>>> import drjit as dr, mitsuba as mi
>>> lattice = TetLattice(32)
>>> points = lattice.points(mi.Float)
>>> bowl = extract(lattice, sdf=dr.norm(points) - 0.7, msdf=0.2 - points.z)
>>> float(dr.max(bowl.vertices.z)[0]) < 0.2 + 1e-5     # cut open at z = 0.2
True
"""

# ruff: noqa: E402
from .streams import begin_command

begin_command()  # before what takes long to import

from .errors import UserError
from .extraction import SurfaceMesh, extract
from .fields import LatticeFields
from .lattice import BccLattice, BlockLattice, CubeLattice, FlexiCubesLattice, TetLattice, make_lattice
from .plugins import register_on_variant_change

__version__ = "0.1.0"
__all__ = [
    "BccLattice",
    "BlockLattice",
    "CubeLattice",
    "FlexiCubesLattice",
    "LatticeFields",
    "SurfaceMesh",
    "TetLattice",
    "UserError",
    "__version__",
    "extract",
    "make_lattice",
]

register_on_variant_change()
