"""The layers of a scene in viser, whose points move."""

from typing import TYPE_CHECKING, Any, Final

import numpy as np
from matplotlib.colors import to_rgb
from numpy.typing import NDArray

from ..data.camera import side_axes, upwards
from ..io.arrays import FloatArray
from ..report.layers import Layer

if TYPE_CHECKING:
    import viser

Triple = tuple[float, float, float]
_AWAY: Final = 1.35  # Distance of the camera, over the size of the body.
_ANGLES: Final = (0.5 * np.pi, 0.26)  # Its azimuth and elevation [rad].
_THIN: Final = 0.003  # Width of lines, over the size of the body.


class LiveScene:
    """Layers of a body of about a metre, as viser's cameras expect it, around the origin.

    Args:
        server: that shows them.
        rest: (N, 3) vertices of the body [m].
        gravity: (3,), down in the pictures.

    Attributes:
        handles: of viser, by the names of the layers that were drawn.
    """

    def __init__(self, server: "viser.ViserServer", rest: FloatArray, gravity: FloatArray) -> None:
        self._scene, self.handles = server.scene, dict[str, Any]()
        self._scale, self._middle = 1.0 / float(np.ptp(rest, axis=0).max()), rest.mean(axis=0)
        up, camera = upwards(gravity), server.initial_camera
        camera.look_at, camera.position = (
            (0.0, 0.0, 0.0),
            _triple(_AWAY * side_axes(up, *_ANGLES)[2]),
        )
        camera.up = _triple(up)
        server.scene.set_up_direction(_triple(up))

    def real(self, point: Triple) -> FloatArray:
        """Returns a point (3,) of the scene [m]."""
        return np.asarray(point, dtype=np.float64) / self._scale + self._middle

    def draw(self, name: str, layer: Layer) -> None:
        """Draws a layer, or moves it to its points; it is hidden where it has none.

        Sizes are over that of the body.
        """
        seen = (
            layer.points
            if layer.cells is not None
            else layer.points[np.isfinite(layer.points).all(axis=1)]
        )
        handle = self.handles.get(name)
        if len(seen):
            points = np.asarray((seen - self._middle) * self._scale, dtype=np.float32)
            points = points[layer.cells] if layer.kind == "lines" else points
            if handle is None:
                handle = self.handles[name] = self._added(name, layer, points)
            setattr(handle, "vertices" if layer.kind == "surface" else "points", points)
        if handle is not None and handle.visible != bool(len(seen)):
            handle.visible = bool(len(seen))

    def _added(self, name: str, layer: Layer, points: NDArray[np.float32]) -> Any:
        red, green, blue = (round(255 * part) for part in to_rgb(layer.colour))
        if layer.kind == "surface" and layer.cells is not None:
            options: dict[str, Any] = {
                "opacity": layer.opacity if layer.opacity < 1.0 else None,
                "side": "double",
            }
            faces, colour = layer.cells.astype(np.uint32), (red, green, blue)
            return self._scene.add_mesh_simple(
                f"/{name}", points, faces, color=colour, flat_shading=True, **options
            )
        if layer.kind == "lines":
            return self._scene.add_line_segments(
                f"/{name}", points, (red, green, blue), thickness=_THIN
            )
        look: dict[str, Any] = {"point_size": layer.size, "point_shape": "circle"}
        return self._scene.add_point_cloud(f"/{name}", points, (red, green, blue), **look)


def _triple(vector: FloatArray) -> Triple:
    x, y, z = vector.tolist()
    return x, y, z
