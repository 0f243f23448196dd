"""Pictures of a tag before a camera."""

import cv2
import numpy as np


def draw_tag(image, camera, matrix, place, right, up, size, number):
    """Draws a tag of 4x4_50, with a white border, into a picture (H, W, 3)
    by a camera (4, 4) and its matrix.
    """
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    tag = np.pad(cv2.aruco.generateImageMarker(dictionary, number, 300), 50, constant_values=255)
    half = size / 2.0
    corners = [
        place + x * half * right + y * half * up for x, y in ((-1, 1), (1, 1), (1, -1), (-1, -1))
    ]
    seen = np.array([matrix @ (camera[:3, :3] @ corner + camera[:3, 3]) for corner in corners])
    pixels = (seen[:, :2] / seen[:, 2:]).astype(np.float32)
    source = np.array(
        [[49.5, 49.5], [349.5, 49.5], [349.5, 349.5], [49.5, 349.5]], dtype=np.float32
    )
    homography = cv2.getPerspectiveTransform(source, pixels)
    shape = (image.shape[1], image.shape[0])
    drawn, where = (
        cv2.warpPerspective(own, homography, shape, flags=cv2.INTER_AREA)
        for own in (tag, np.full_like(tag, 255))
    )
    return np.where(where[..., None] > 127, drawn[..., None], image).astype(np.uint8)
