"""A disc on a grid by brute force: every occupied square, every millimetre."""

from __future__ import annotations

import math

import numpy as np


class DiscWorld:
    """occupied [height, width]; outside is occupied. Points are in grid metres, radius in metres."""

    def __init__(self, occupied, resolution, origin, radius, offset):
        rows, columns = np.nonzero(occupied)
        self.taken = np.stack([columns, rows], 1) * resolution  # lower-left corners
        rows, columns = np.nonzero(~np.asarray(occupied))
        self.free = np.stack([columns, rows], 1) * resolution
        self.size = np.array(np.shape(occupied)[::-1]) * resolution
        self.h, self.origin, self.radius, self.offset = resolution, origin, radius, offset

    def centre(self, pose):
        """The footprint's centre in grid metres."""
        x, y, theta = pose
        x0, y0, yaw = self.origin
        z = complex(x, y) + complex(*self.offset) * np.exp(1j * theta) - complex(x0, y0)
        z *= np.exp(-1j * yaw)
        return np.array([z.real, z.imag])

    def _to_squares(self, points, corners):
        low = corners[None] - points[:, None]
        outside = np.maximum(0.0, np.maximum(low, -low - self.h))
        return np.hypot(outside[..., 0], outside[..., 1]).min(axis=1)

    def gap(self, points):
        """Metres from points [n, 2] to what is occupied; minus the depth where a point is inside."""
        points = np.atleast_2d(points)
        edge = np.minimum(points, self.size - points).min(axis=1)
        gap = np.maximum(edge, 0.0)
        if len(self.taken):
            gap = np.minimum(gap, self._to_squares(points, self.taken))
        inside = gap == 0.0
        if inside.any():
            gap[inside] = -self._to_squares(points[inside], self.free)
        return gap

    def overlap(self, pose):
        return self.radius - float(self.gap(self.centre(pose))[0])

    def along(self, start, end, spacing=1e-3):
        """The gaps at points every `spacing` metres from one centre to another."""
        n = max(math.ceil(np.linalg.norm(end - start) / spacing), 1)
        return self.gap(start + (end - start) * np.linspace(0.0, 1.0, n + 1)[:, None])
