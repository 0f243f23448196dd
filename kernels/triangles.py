"""Queries of closed surfaces of triangles, ``wp.Mesh``, in float32."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def from_surface(surface: wp.uint64, places: wp.array[wp.vec3], distance_out: wp.array[float]):
    """Signed distances of places from a closed surface [m]."""
    i = wp.tid()
    query = wp.mesh_query_point_sign_winding_number(surface, places[i], 1.0e6)
    nearest = wp.mesh_eval_position(surface, query.face, query.u, query.v)
    distance_out[i] = query.sign * wp.length(places[i] - nearest)


@wp.kernel
def blocked(surface: wp.uint64, starts: wp.array[wp.vec3], directions: wp.array[wp.vec3], blocked_out: wp.array[float]):
    """Marks rays that hit a surface with one."""
    i = wp.tid()
    if wp.mesh_query_ray(surface, starts[i], directions[i], 1.0e6).result:
        blocked_out[i] = 1.0
