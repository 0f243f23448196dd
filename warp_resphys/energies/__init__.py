"""Energies of a body: materials, actuators, contact and surroundings."""

from ..stepping.quantity import Quantity as Quantity
from .base import Energy as Energy
from .catalogue import make_material as make_material
from .catalogue import share_outside_law as share_outside_law
from .materials import ConvexMaterial as ConvexMaterial
from .materials import DensityMaterial as DensityMaterial
from .materials import FibreFamily as FibreFamily
from .materials import Gent as Gent
from .materials import Material as Material
from .materials import MooneyRivlin as MooneyRivlin
from .medium import Medium as Medium
from .muscles import Muscle as Muscle
from .obstacles import Box as Box
from .obstacles import Capsule as Capsule
from .obstacles import DistanceGrid as DistanceGrid
from .obstacles import Sphere as Sphere
from .pointwise import PointwiseEnergy as PointwiseEnergy
from .strings import Strings as Strings
from .surfaces import FrictionPair as FrictionPair
