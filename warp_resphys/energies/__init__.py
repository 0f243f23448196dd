"""Energies of a body: materials, actuators, contact and surroundings."""

from ..settings.body import Route as Route
from ..settings.contact import Box as Box
from ..settings.contact import Capsule as Capsule
from ..settings.contact import FrictionPair as FrictionPair
from ..settings.contact import Sphere as Sphere
from ..settings.contact import SurfaceFile as SurfaceFile
from ..stepping.quantity import Quantity as Quantity
from ..stepping.quantity import parameter as parameter
from .base import Energy as Energy
from .catalogue import make_material as make_material
from .catalogue import share_outside_law as share_outside_law
from .contact.obstacles import DistanceGrid as DistanceGrid
from .convex_material import ConvexMaterial as ConvexMaterial
from .convex_material import FibreFamily as FibreFamily
from .materials import DensityMaterial as DensityMaterial
from .materials import Gent as Gent
from .materials import Material as Material
from .materials import MooneyRivlin as MooneyRivlin
from .medium import Medium as Medium
from .muscles import Muscle as Muscle
from .pointwise import PointwiseEnergy as PointwiseEnergy
