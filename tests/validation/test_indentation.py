r"""Rigid spheres and cylinders that are pressed into a block bonded to a rigid base, beside theory.

The sphere's force is Hertz's, 4/3 E* sqrt(R) d^1.5, with the correction for the thickness of the layer (Dimitriadis et
al. 2002). The cylinder's, along a line, has no limit for a thick layer. It follows from the displacement u of the
surface under a pressure p in plane strain, without friction: for a wave number k and a layer of the thickness t,

    u(k) = 2 (1 - nu^2) / (E k) K(k t) p(k),
    K(x) = (c sinh 2x - 2x) / (c cosh 2x + 2x^2 + 5 - 12 nu + 8 nu^2),     c = 3 - 4 nu

(Carbone and Mangialardi 2008). Pressures within the contact make u follow the cylinder, and the contact is where they
are positive. Depths are below the undeformed surface and include the gap of the barrier.

E. K. Dimitriadis et al.: Determination of elastic moduli of thin layers of soft material using the atomic force
microscope. Biophysical Journal 82, 2002.
G. Carbone, L. Mangialardi: Analysis of the adhesive contact of confined layers by using a Green's function approach.
Journal of the Mechanics and Physics of Solids 56, 2008.
"""

import math

import numpy as np
import scipy.linalg
import torch

from support.contact import pressure
from warp_resphys import Body, Contact, Mesh, Simulator, StableNeoHookean, box_hexahedra
from warp_resphys.energies.contact.contact_points import vertex_areas
from warp_resphys.settings.contact import Cylinder, Sphere

YOUNG, POISSON = 264e3, 0.45  # Pa, -
GROWTH = 1.4  # of the cells away from the contact, from one to the next
SPHERE_RADIUS, SPHERE_DEPTH = 0.02, 0.5e-3  # m
CYLINDER_RADIUS = 0.2  # m
DEPTHS = np.linspace(2e-5, 5e-5, 8)  # of the cylinder; each contact ends elsewhere between vertices [m]
_ALONG = (0.0, 1.0, 2.0, 4.0, 6.0)  # vertices along the cylinder, over the thickness of the layer
_POINTS = 2**14  # of the surface of a layer


def sphere_error(cell, device):
    """Relative error of the force on a sphere, for a size of the cells below it [m], which grow with the distance."""
    lines = _lines(cell, GROWTH, 0.03)
    mesh, ball = _block(lines, lines, lines), Sphere(radius=SPHERE_RADIUS)
    ((force, d),) = press(ball, mesh, [SPHERE_DEPTH], 2e-5, 1e5, device)
    depth = SPHERE_DEPTH + float((force * d).sum() / force.sum())
    return float(force.sum()) / hertz_force(SPHERE_RADIUS, depth, lines[-1]) - 1.0


def cylinder_errors(cell, device):
    """Relative errors of the force on a cylinder at `DEPTHS`, for a size of the cells below it [m].

    The growth of the cells is refined with their size. The force is that on the middle of a block twelve times as long
    as it is thick, which is in plane strain there.
    """
    growth = GROWTH ** (cell / 1e-3)
    layer, wide = _lines(cell, growth, 0.01), _lines(cell, growth, 0.05)
    along = layer[-1] * np.array(_ALONG)
    mesh, rod = _block(wide, along, layer), Cylinder(radius=CYLINDER_RADIUS, length=1.0, axis=(0.0, 1.0, 0.0))
    middle, errors = np.abs(mesh.vertices[:, 1]) < 1e-9, []
    for depth, (force, d) in zip(DEPTHS, press(rod, mesh, DEPTHS, 1e-6, 2e5, device), strict=True):
        own = force * middle
        gap = float((own * d).sum() / own.sum())
        expected = layer_force(CYLINDER_RADIUS, depth + gap, layer[-1])
        errors.append(own.sum() / along[1] / expected - 1.0)
    return np.array(errors)


def _lines(cell, growth, extent):
    """Distances from zero to an extent or a little further [m], between which cells grow by a factor."""
    count = math.ceil(math.log(1.0 + extent * (growth - 1.0) / cell) / math.log(growth))
    return np.concatenate([[0.0], np.cumsum(cell * growth ** np.arange(count))])


def _block(x, y, depth):
    """A block below z = 0, with vertices at distances to both sides of zero along x and y, and at depths [m]."""
    lines = [np.concatenate([-way[:0:-1], way]) for way in (x, y)] + [-depth[::-1]]
    counts = [len(line) - 1 for line in lines]
    box = box_hexahedra((1.0, 1.0, 1.0), (counts[0], counts[1], counts[2]))
    index = np.rint(box.vertices * counts).astype(int)
    return Mesh(np.stack([line[own] for line, own in zip(lines, index.T, strict=True)], 1), box.cells)


def press(obstacle, mesh, depths, distance, stiffness, device):
    """Presses an obstacle at depths [m] below z = 0 into a block with a fixed base.

    Returns vertical forces [N] and distances [m] of the vertices, (N,), for every depth.
    """
    radius, deep = obstacle.radius, -float(mesh.vertices[:, 2].min())
    obstacle = obstacle.changed(position=(0.0, 0.0, radius + distance))
    contact = Contact({"obstacle": obstacle}, stiffness, distance=distance)
    fixed = np.flatnonzero(mesh.vertices[:, 2] < -deep + 1e-9)
    rubber = StableNeoHookean(youngs_modulus=YOUNG, poissons_ratio=POISSON, density=1070.0)
    body = Body(mesh, fixed=fixed, energies=[contact])
    s = Simulator(body, rubber, gravity=(0.0, 0.0, 0.0), device=device)
    # The start is the surface pushed clear of the obstacle.
    x, down = s.rest_positions, s.tensor(depths)[:, None] + distance
    across = x[:, : 2 if isinstance(obstacle, Sphere) else 1].square().sum(1).clamp_max(radius**2)
    push = (down - radius + (radius**2 - across).sqrt() - 0.4 * distance).clamp_min(0.0)
    start = x.expand(len(down), -1, -1).clone()
    start[..., 2] -= push * (1.0 + x[:, 2] / deep)
    with torch.no_grad():
        q = s.static_equilibrium(None, {"obstacle_z": -down}, after=s.state(start)).q
    q[..., 2] += down
    away = q.cpu().numpy() - obstacle.position
    away[..., 1] *= isinstance(obstacle, Sphere)
    far = np.linalg.norm(away, axis=-1)
    d = far - radius
    forces = -stiffness * vertex_areas(mesh) * pressure(np.minimum(d / distance, 1.0)) * away[..., 2] / far
    return list(zip(forces, d, strict=True))


def hertz_force(radius, depth, thickness):
    """Force [N] on a rigid sphere that is pressed into a bonded layer (Dimitriadis et al. 2002, equation 12)."""
    nu, chi = POISSON, math.sqrt(radius * depth) / thickness
    a = -(1.2876 - 1.4678 * nu + 1.3442 * nu**2) / (1.0 - nu)
    b = (0.6387 - 1.0277 * nu + 1.5164 * nu**2) / (1.0 - nu)
    p = math.pi
    layer = 1.0 - 2.0 * a / p * chi + 4.0 * (a / p * chi) ** 2 - 8.0 / p**3 * (a**3 + 4.0 * p**2 / 15.0 * b) * chi**3
    layer += 16.0 * a / p**4 * (a**3 + 3.0 * p**2 / 5.0 * b) * chi**4
    return 4.0 / 3.0 * YOUNG / (1.0 - nu**2) * math.sqrt(radius) * depth**1.5 * layer


def layer_response(wave_number, thickness):
    """Displacement over pressure [m/Pa] of the surface of a bonded layer, by positive wave numbers [1/m]."""
    nu, x = POISSON, wave_number * thickness
    c, decay = 3.0 - 4.0 * nu, np.exp(-2.0 * x)
    above = c * (1.0 - decay**2) - 4.0 * x * decay
    below = c * (1.0 + decay**2) + (4.0 * x**2 + 10.0 - 24.0 * nu + 16.0 * nu**2) * decay
    return 2.0 * (1.0 - nu**2) / YOUNG / wave_number * above / below


def layer_force(radius, depth, thickness):
    """Force over length [N/m] on a rigid cylinder that is pressed into a bonded layer in plane strain."""
    nu, most = POISSON, math.sqrt(2.0 * radius * depth)  # half of the width without a rise beside the contact
    spacing = (12.0 * thickness + 4.0 * most) / _POINTS  # of points in a period that is long enough
    waves = 2.0 * np.pi * np.arange(_POINTS // 2 + 1, dtype=np.float64) / (_POINTS * spacing)
    uniform = thickness * (1.0 + nu) * (1.0 - 2.0 * nu) / ((1.0 - nu) * YOUNG)
    response = np.concatenate([[uniform], layer_response(waves[1:], thickness)])
    green = np.fft.irfft(response, _POINTS)  # displacements under a pressure at one point
    half = int(most / spacing)
    x = spacing * np.arange(-half, half + 1)
    into = depth - radius + np.sqrt(radius**2 - x**2)
    while True:
        own = scipy.linalg.solve_toeplitz(green[: len(into)], into)
        if own.min() >= 0.0:
            return float(own.sum() * spacing)
        into = into[own >= 0.0]


def test_the_force_on_a_sphere_is_that_of_hertz(device):
    """For a sphere of 20 mm, 0.5 mm deep, within 2 % with cells of 0.18 mm."""
    assert abs(sphere_error(1.8e-4, device)) < 0.02


def test_the_force_on_a_cylinder_is_that_of_plane_strain(device):
    """At eight depths within 2 % with cells of 0.35 mm, and of almost second order in their size."""
    cells = (1e-3, 7e-4, 5e-4, 3.5e-4)
    errors = [cylinder_errors(cell, device) for cell in cells]
    assert np.abs(errors[-1]).max() < 0.02
    means = [np.sqrt(np.mean(error**2)) for error in errors]
    assert np.polyfit(np.log(cells), np.log(means), 1)[0] > 1.5
