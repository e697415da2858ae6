"""A z-buffer for triangle meshes: flat-shaded views of many vertex sets at once, as a black box.

A pixel shows the nearest triangle that its centre is in, so the image is piecewise constant where vertices move along
the image and jumps at silhouettes. Most triangles are smaller than a pixel: all pixel centres in the bounding boxes of
all triangles are tested together, and one reduction over them finds the nearest.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

AMBIENT = 0.25
"""Light on a triangle that is turned away from the lamp; the background is 0."""
LAMP = (-0.4, 0.5, 0.8)
"""Direction to the lamp in the frame of every camera: right, up, towards the viewer."""
NEAREST = 0.05
"""Triangles with a corner nearer to the camera than this are left out."""
_CORNERS = 2**19
"""Triangles that are projected at once, for the memory."""


@dataclass(frozen=True)
class Cameras:
    """Pinhole cameras that look at the origin, all with the same square film.

    Args:
        eyes: [v, 3], none of them above or below the origin; y is up.
        side: of the film in pixels.
        extent: half of the visible width of the plane through the origin that faces the camera.
    """

    eyes: Tensor
    side: int
    extent: float

    @staticmethod
    def around(count: int, elevations: Sequence[float], distance: float, side: int, extent: float) -> "Cameras":
        """Look from `count` equally spaced azimuths and, in turn, from these elevations [degrees]."""
        azimuth = 2 * math.pi * torch.arange(count, dtype=torch.float64) / count
        elevation = torch.deg2rad(torch.tensor(elevations, dtype=torch.float64))[torch.arange(count) % len(elevations)]
        level = elevation.cos()
        eyes = torch.stack([level * azimuth.sin(), elevation.sin(), level * azimuth.cos()], 1)
        return Cameras(distance * eyes, side, extent)

    @property
    def pixels(self) -> float:
        """Pixels along a length of 1 in the plane through the origin."""
        return self.side / (2 * self.extent)

    @property
    def axes(self) -> Tensor:
        """Right, up and backward unit vectors of every camera, [v, 3, 3]."""
        back = torch.nn.functional.normalize(self.eyes, dim=1)
        right = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([[0.0, 1.0, 0.0]]).to(back), back), dim=1)
        return torch.stack([right, torch.linalg.cross(back, right), back], 1)

    def project(self, vertices: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Project vertices [K, m, 3].

        Returns: x to the right and y downward in pixels (centres of pixels at whole numbers), and the depth along the
            view direction, [K, v, m] each.
        """
        axes, eyes = self.axes.to(vertices), self.eyes.to(vertices)
        right, up, back = (_along(vertices, axes[:, i]) for i in range(3))
        distance = eyes.norm(dim=1)[:, None]
        depth = distance - back
        scale = 0.5 * self.side * distance / (self.extent * depth)
        middle = 0.5 * self.side - 0.5
        return middle + scale * right, middle - scale * up, depth


def render(cameras: Cameras, vertices: Tensor, faces: Tensor, colors: Tensor | None = None) -> Tensor:
    """Flat-shaded views of K meshes with the same triangles.

    A triangle has the brightness a + (1 - a) max(0, n.l) with n its normal, l `LAMP` and a `AMBIENT`. It is seen from
    both sides, with n the side from which it is counterclockwise. Colours are interpolated between the vertices.

    Args:
        cameras: the views.
        vertices: [K, m, 3].
        faces: [k, 3].
        colors: [K, m, c] or None.

    Returns: [K, v, side, side] float32, or [K, v, side, side, c] with colours; row 0 is the top.
    """
    most = max(1, _CORNERS // (len(cameras.eyes) * len(faces)))
    pieces = [
        _render(cameras, part.float(), faces, None if colors is None else colors[most * i :][:most].float())
        for i, part in enumerate(vertices.split(most))
    ]
    return torch.cat(pieces)


def _render(cameras: Cameras, vertices: Tensor, faces: Tensor, colors: Tensor | None) -> Tensor:
    K, v, side = len(vertices), len(cameras.eyes), cameras.side
    corners, image, face = _on_film(cameras, vertices, faces)
    owner, pixel, weights, nearness = _candidates(corners, side)
    # The nearest candidate of every pixel: the bits of positive floats are in the order of the floats.
    key = (nearness.view(torch.int32).long() << 32) + torch.arange(len(owner))
    best = torch.full((K * v * side * side,), -1)
    best.scatter_reduce_(0, image[owner] * side * side + pixel, key, "amax")
    seen = torch.nonzero(best >= 0).squeeze(1)
    winner = best[seen] & 0xFFFFFFFF
    shown = owner[winner]
    k, view = image[shown] // v, image[shown] % v
    shade = _shading(cameras, vertices, faces)[k, view, face[shown]]
    if colors is None:
        return torch.zeros(len(best)).index_put_((seen,), shade).view(K, v, side, side)
    share = weights[winner] / weights[winner].sum(1, keepdim=True)
    color = (colors[k[:, None], faces[face[shown]]] * share[:, :, None]).sum(1) * shade[:, None]
    return torch.zeros(len(best), color.shape[1]).index_put_((seen,), color).view(K, v, side, side, -1)


def _along(vectors: Tensor, directions: Tensor) -> Tensor:
    """Products of vectors [K, m, 3] with directions [v, 3], [K, v, m]; the bits of one do not depend on the others."""
    x, y, z = (one[:, None] for one in vectors.unbind(2))
    u, v, w = (one[:, None] for one in directions.unbind(1))
    return x * u + y * v + z * w


def _on_film(cameras: Cameras, vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Triangles whose bounding box has a pixel centre on the film.

    Returns: corners [t, 9] (x, y and 1/depth of the three), number of the image k * v + view [t], number of the face.
    """
    x, y, depth = cameras.project(vertices)
    nearness = torch.where(depth > NEAREST, 1 / depth, math.nan)
    # Vertices first: a gather then reads whole rows, one number for every image.
    rows = [one.flatten(0, 1).T.contiguous() for one in (x, y, nearness)]
    planes = [one.index_select(0, corner) for corner in faces.unbind(1) for one in rows]
    box = _box(planes, cameras.side)
    has = (box[0] <= box[1]) & (box[2] <= box[3]) & ~(planes[2] + planes[5] + planes[8]).isnan()
    chosen = torch.nonzero(has.flatten()).squeeze(1)
    images = rows[0].shape[1]
    corners = torch.stack([one.flatten().index_select(0, chosen) for one in planes], 1)
    return corners, chosen % images, chosen // images


def _box(planes: Sequence[Tensor], side: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """First and last column and row of the pixel centres in the bounding boxes, on the film; NaN stays NaN."""
    (ax, ay, _), (bx, by, _), (cx, cy, _) = planes[:3], planes[3:6], planes[6:]
    return (
        torch.minimum(torch.minimum(ax, bx), cx).ceil_().clamp_(min=0),
        torch.maximum(torch.maximum(ax, bx), cx).floor_().clamp_(max=side - 1),
        torch.minimum(torch.minimum(ay, by), cy).ceil_().clamp_(min=0),
        torch.maximum(torch.maximum(ay, by), cy).floor_().clamp_(max=side - 1),
    )


def _candidates(corners: Tensor, side: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Pixel centres that are in a triangle [t, 9].

    Returns: its number [c], the pixel [c], barycentric weights [c, 3] up to a factor, and 1/depth [c].
    """
    left, right, top, bottom = (one.int() for one in _box(corners.unbind(1), side))
    width = right - left + 1
    count = width * (bottom - top + 1)
    owner = torch.repeat_interleave(count)
    before = count.cumsum(0, dtype=torch.int32) - count
    first, left, top, width = torch.stack([before, left, top, width], 1).index_select(0, owner).unbind(1)
    place = torch.arange(len(owner), dtype=torch.int32) - first
    row = place // width
    column = left + place - row * width
    row = row + top
    ax, ay, az, bx, by, bz, cx, cy, cz = corners.index_select(0, owner).unbind(1)
    ax, bx, cx = (one - column for one in (ax, bx, cx))
    ay, by, cy = (one - row for one in (ay, by, cy))
    # In this form an edge has exactly the opposite sign for the triangle on its other side: no pixel falls between.
    a, b, c = bx * cy - cx * by, cx * ay - ax * cy, ax * by - bx * ay
    area = a + b + c
    inside = (((a >= 0) & (b >= 0) & (c >= 0)) | ((a <= 0) & (b <= 0) & (c <= 0))) & (area != 0)
    nearness = (a * az + b * bz + c * cz) / area
    kept = torch.nonzero(inside).squeeze(1)
    weights = torch.stack([one[kept] for one in (a * az, b * bz, c * cz)], 1)  # perspective: in space, not on the film
    return owner[kept], (row * side + column)[kept].long(), weights, nearness[kept]


def _shading(cameras: Cameras, vertices: Tensor, faces: Tensor) -> Tensor:
    """Brightness of every face in every view, [K, v, k]."""
    a, b, c = (vertices[:, corner] for corner in faces.unbind(1))
    normals = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=2)
    lamp = torch.nn.functional.normalize(torch.tensor(LAMP, dtype=torch.float64), dim=0)
    lamps = (cameras.axes * lamp[:, None]).sum(1).to(vertices)
    lambert = _along(normals, lamps).clamp_(min=0)
    return AMBIENT + (1 - AMBIENT) * lambert
