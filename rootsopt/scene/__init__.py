"""Config to numbers: the scene, its rotor pair, and the bounds and sizes of designs."""

from rootsopt.scene.build import Scene as Scene
from rootsopt.scene.check import check_geometry as check_geometry
from rootsopt.scene.check import outline_mm as outline_mm
from rootsopt.scene.reading import design_vector as design_vector
