"""Bodies seen by cameras: outlines, tracked points, depths and scans,
and the parameters that explain them.
"""

from ..data.camera import CameraMarkers as CameraMarkers
from ..data.camera import Lens as Lens
from ..data.camera import PlacedCamera as PlacedCamera
from .clouds import Cloud as Cloud
from .outlines import ClosedSurface as ClosedSurface
from .outlines import Outline as Outline
from .picture_misfit import PictureMisfit as PictureMisfit
from .released_force import ReleasedForce as ReleasedForce
from .scene_files import read_scan as read_scan
from .seen import Photo as Photo
from .seen import SeenPose as SeenPose
