"""Hole plates drawn by ray casting and supersampling: nothing of the detection is used."""

import cv2
import numpy as np

from sl_calibration.target.plate import Plate

PLATE = Plate(columns=7, rows=6, pitch_m=1e-3, diameter_m=0.5e-3)
BLUR_PX = 0.8
#: Per pixel and axis; edges run over one sub-pixel.
SUBSAMPLES = 3
#: Where edges are sharp (chamfers): leaves centres uncertain by 0.0035 px for circles of 21 px
#: (measured by halving the step: 0.005 with 4, 0.0025 with 8).
SHARP_SUBSAMPLES = 6


def pinhole(tilt_deg=0.0, turn_deg=0.0, centre_px=(200.0, 150.0), scale=42e3, distance_m=40e-3):
    """Homography (3, 3) of the plate's front: turned in its plane, then tilted about image v.

    ``scale`` is px/m in the plate's middle; plate y is up in the image (v down) without a turn.
    """
    a, b = np.deg2rad([turn_deg, tilt_deg])
    turn = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    plate = np.diag([np.cos(b), 1.0]) @ turn
    depth = np.sin(b) * turn[0] / distance_m  # 1 + x sin(tilt) / distance
    top = scale * np.array([[1.0, 0.0], [0.0, -1.0]]) @ plate
    h = np.eye(3)
    h[:2, :2], h[2, :2] = top, depth
    h[:2, 2] = 0.0
    return np.array([[1, 0, centre_px[0]], [0, 1, centre_px[1]], [0, 0, 1.0]]) @ h


def through(h, xy):
    """Image points (..., 2) of plate points (..., 2)."""
    local = np.asarray(xy) @ h[:, :2].T + h[:, 2]
    return local[..., :2] / local[..., 2:]


def subpixels(size, n=SUBSAMPLES):
    """Sub-pixel positions (H n, W n, 2) of an image of (width, height)."""
    u, v = ((np.arange(k * n) + 0.5) / n - 0.5 for k in size)
    return np.stack(np.meshgrid(u, v), axis=-1)


def exposed(albedo, noise_dn=1.0, bright=190.0, dark=6.0, seed=0, blur_px=BLUR_PX, n=SUBSAMPLES):
    """Sub-pixel reflectance in [0, 1] to an 8-bit image: pixel aperture, blur, noise, rounding."""
    h, w = albedo.shape[0] // n, albedo.shape[1] // n
    sharp = cv2.GaussianBlur(albedo, (0, 0), blur_px * n, borderType=cv2.BORDER_REPLICATE)
    pixels = dark + (bright - dark) * sharp.reshape(h, n, w, n).mean(axis=(1, 3))
    pixels += np.random.default_rng(seed).normal(0.0, noise_dn, (h, w))
    return np.clip(np.rint(pixels), 0, 255).astype(np.uint8)


def drawn(plate, h, size=(400, 300), lost=(), radii=None, **exposure):
    """Image of a plate without depth under a homography."""
    q = subpixels(size)
    xy = through(np.linalg.inv(h), q)
    footprint = np.linalg.norm(xy[0, 1] - xy[0, 0])
    middle = 0.5 * np.array([plate.columns - 1, plate.rows - 1])
    ids = np.clip(np.rint(xy / plate.pitch_m + middle), 0, 2 * middle).astype(int)
    radius = np.full((plate.columns, plate.rows), plate.diameter_m / 2)
    if plate.origin_diameter_m:
        radius[plate.origin_id] = plate.origin_diameter_m / 2
    for hole in lost:
        radius[hole] = 0.0
    offset = np.linalg.norm(xy - (ids - middle) * plate.pitch_m, axis=-1)
    r = radius[ids[..., 0], ids[..., 1]]
    face = np.where(r > 0, np.clip((offset - r) / footprint + 0.5, 0.0, 1.0), 1.0)
    return exposed(face if plate.dark_holes else 1.0 - face, **exposure)


def chamfered(plate, tilt_deg=28.0, size=(400, 300), scale=42e3, slope_level=0.7, **exposure):
    """Image of a plate with 45 degree chamfers, seen from afar at a tilt about v; and centres.

    Returns the image and the pixels (N, 2) of the centres of the holes' bottoms, ordered by ids.
    """
    a = np.deg2rad(tilt_deg)
    middle = 0.5 * np.array([plate.columns - 1, plate.rows - 1])
    q = (subpixels(size, SHARP_SUBSAMPLES) - 0.5 * np.array(size)) / scale
    face = np.stack([q[..., 0] / np.cos(a), -q[..., 1]], axis=-1)  # where the ray meets z = 0
    ids = np.clip(np.rint(face / plate.pitch_m + middle), 0, 2 * middle)
    x, y = np.moveaxis(face - (ids - middle) * plate.pitch_m, -1, 0)
    # the ray (x + z tan, y, z) meets the cone r = top + z: a quadratic in z
    top, t = plate.diameter_m / 2 + plate.chamfer_m, np.tan(a)
    c, b = x * x + y * y - top**2, x * t - top
    z = np.maximum(c / (-b + np.sqrt(np.maximum(b * b - (t * t - 1) * c, 0.0))), -plate.chamfer_m)
    r = np.hypot(x + z * t, y)
    albedo = np.where(c > 0, 1.0, np.where(r < plate.diameter_m / 2, 0.0, slope_level))
    columns, rows = np.meshgrid(np.arange(plate.columns), np.arange(plate.rows))
    bottoms = (np.stack([columns.ravel(), rows.ravel()], axis=1) - middle) * plate.pitch_m
    # a point at depth -w is seen where its ray meets the face: x - z tan
    u = (bottoms[:, 0] + plate.chamfer_m * t) * np.cos(a) * scale + size[0] / 2
    image = exposed(albedo, n=SHARP_SUBSAMPLES, **exposure)
    return image, np.stack([u, size[1] / 2 - bottoms[:, 1] * scale], axis=1)
