"""Energies of a body: materials, actuators, contact and surroundings."""

from .core.energies.base import Energy as Energy
from .core.energies.catalogue import make_material as make_material
from .core.energies.catalogue import share_outside_law as share_outside_law
from .core.energies.contact.obstacles import DistanceGrid as DistanceGrid
from .core.energies.contact.touching_bodies import Box as Box
from .core.energies.contact.touching_bodies import Capsule as Capsule
from .core.energies.contact.touching_bodies import FrictionPair as FrictionPair
from .core.energies.contact.touching_bodies import Sphere as Sphere
from .core.energies.contact.touching_bodies import SurfaceFile as SurfaceFile
from .core.energies.convex_material import ConvexMaterial as ConvexMaterial
from .core.energies.convex_material import FibreFamily as FibreFamily
from .core.energies.materials import DensityMaterial as DensityMaterial
from .core.energies.materials import Gent as Gent
from .core.energies.materials import Material as Material
from .core.energies.materials import MooneyRivlin as MooneyRivlin
from .core.energies.medium import Medium as Medium
from .core.energies.muscles import Muscle as Muscle
from .core.energies.pointwise import PointwiseEnergy as PointwiseEnergy
from .core.energies.route import Route as Route
from .core.stepping.quantity import Quantity as Quantity
from .core.stepping.quantity import parameter as parameter

__path__: list[str] = []  # modules below it have moved (`moved`)
