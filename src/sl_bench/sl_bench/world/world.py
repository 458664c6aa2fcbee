"""The simulated world of the bench: rig, part, stage pose and mirrors give the camera's image.

Mirrors -> blurred pattern on the part -> reflected light, shadows -> lens and pixel aperture ->
electrons -> shot and read noise -> DN. Emulators of devices share one `World`; it knows none of
them. World frame: metres, z = 0 the reference plane, z up towards the devices.
"""

from __future__ import annotations

import hashlib
import itertools
import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sl_bench.world import photons, raycast, shading, truth
from sl_bench.world import stripe_images as stripes
from sl_bench.world.optics import Finish, Optics, make_finish
from sl_bench.world.surfaces import Surface
from sl_common.errors import ConfigError
from sl_reconstruct.model.rig import ORTHONORMAL_TOLERANCE, Rig

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Mirrors = NDArray[np.uint8] | NDArray[np.bool_]
Axis = Literal["column", "row"]

#: Noise-free frames kept; a `precise` stack repeated at a pose costs only its noise.
CACHED_FRAMES = 30
#: A strip of rows is the unit of work of a thread.
STRIPS_PER_THREAD = 4


def in_strips(work: Callable[[tuple[int, int]], None], rows: int) -> None:
    """Call ``work((first, behind_last))`` for strips that cover all rows, on all cores.

    Parameters
    ----------
    work : callable
        Takes the first row of a strip and the one behind its last.
    rows : int
        Number of rows.
    """
    threads = os.cpu_count() or 1
    edges = np.linspace(0, rows, min(threads * STRIPS_PER_THREAD, rows) + 1).astype(int)
    with ThreadPoolExecutor(threads) as pool:
        for _ in pool.map(work, [(int(a), int(b)) for a, b in itertools.pairwise(edges)]):
            pass


@dataclass(frozen=True)
class Scene:
    """The part as it stands: what a frame depends on besides the mirrors."""

    surface: Surface
    finish: Finish
    rotation: Array
    translation_m: Array
    part_number: int

    @property
    def key(self) -> tuple[int, bytes]:
        """Equal where frames are equal."""
        return self.part_number, self.rotation.tobytes() + self.translation_m.tobytes()


@dataclass(frozen=True)
class Geometry:
    """Sample maps of a scene, and what the mirrors of each axis are blurred by."""

    maps: stripes.Samples
    levels: tuple[stripes.Levels, stripes.Levels]
    ambient: Image


class World:
    """One part under one rig.

    Parameters
    ----------
    rig : Rig
        Camera and projector; the true one.
    surface : Surface
        The part on the stage.
    optics : Optics
        Light, blur and sensor.
    finish : Finish or str
        Of the part; a name is looked up in `sl_bench.world.optics.FINISHES`.

    Notes
    -----
    All methods may be called from any thread; frames are rendered one at a time, and a frame is
    of the pose at its call. The lens's defocus is exact for stripes; shadow borders and edges of
    albedo get the in-focus blur everywhere.
    """

    def __init__(
        self,
        rig: Rig,
        surface: Surface,
        optics: Optics | None = None,
        finish: Finish | str = "matt",
    ) -> None:
        self.rig = rig
        self.optics = optics or Optics()
        self._scene_lock = threading.Lock()
        self._render_lock = threading.RLock()
        self._frames: OrderedDict[tuple[object, ...], Image] = OrderedDict()
        self._geometry: tuple[object, Geometry] | None = None
        self._maps: tuple[Image, ...] | None = None
        self._weights = stripes.lens_weights(self.optics.lens_blur_px)
        self._scene = Scene(surface, _finish(finish), np.eye(3), np.zeros(3), 0)

    @property
    def surface(self) -> Surface:
        """The part on the stage."""
        return self._scene.surface

    @property
    def pose(self) -> tuple[Array, Array]:
        """world_from_part: rotation (3, 3), translation (3,) metres."""
        return self._scene.rotation, self._scene.translation_m

    def move(self, rotation: Array, translation_m: Array) -> None:
        """Put the part at a pose, world_from_part; costs nothing until the next frame.

        Parameters
        ----------
        rotation : ndarray, (3, 3)
            World from part.
        translation_m : ndarray, (3,)
            The part's origin in the world, metres.

        Raises
        ------
        ConfigError
            When the rotation is not one or a number is not finite.
        """
        R = np.array(rotation, dtype=np.float64)
        t = np.array(translation_m, dtype=np.float64)
        if R.shape != (3, 3) or t.shape != (3,) or not np.isfinite([*R.flat, *t]).all():
            raise ConfigError(f"pose {R.tolist()}, {t.tolist()}; expected 3x3 and 3 finite numbers")
        if np.abs(R @ R.T - np.eye(3)).max() > ORTHONORMAL_TOLERANCE or np.linalg.det(R) < 0:
            raise ConfigError(f"pose rotation {R.tolist()}; expected an orthonormal matrix, det +1")
        with self._scene_lock:
            s = self._scene
            self._scene = Scene(s.surface, s.finish, R, t, s.part_number)

    def put(self, surface: Surface, finish: Finish | str | None = None) -> None:
        """Exchange the part, at the pose where the old one stood; the finish stays unless given.

        Parameters
        ----------
        surface : Surface
            The new part.
        finish : Finish or str, optional
            Its finish, or the name of one.
        """
        with self._scene_lock:
            s = self._scene
            new = s.finish if finish is None else _finish(finish)
            self._scene = Scene(surface, new, s.rotation, s.translation_m, s.part_number + 1)

    # -- light -----------------------------------------------------------------------------

    def electrons_per_second(self, mirrors: Mirrors) -> Image:
        """Noise-free electrons per second that the projected light makes, (H, W), read-only.

        Parameters
        ----------
        mirrors : ndarray, (rows, columns)
            What the DMD shows; not 0 is on. Patterns along one axis are fast, any other works.
            Ambient light is not in it; see `ambient_e_per_s`.

        Raises
        ------
        ConfigError
            When the shape is not the rig's DMD.
        """
        return self._projected(self._scene, mirrors)

    def _projected(self, scene: Scene, mirrors: Mirrors) -> Image:
        columns, rows = self.rig.projector.image_size
        if mirrors.shape != (rows, columns):
            raise ConfigError(f"mirrors.shape={mirrors.shape}; expected {(rows, columns)}")
        return self._shown(scene, np.ascontiguousarray(mirrors) != 0)

    def _shown(self, scene: Scene, on: NDArray[np.bool_]) -> Image:
        """Light of a mirror image; of each pair of inverses only one is rendered."""

        def make() -> Image:
            if on[0, 0] and not on.all():
                return _difference(self._shown(scene, np.ones_like(on)), self._shown(scene, ~on))
            return self._render(self._traced(scene), on)

        return self._kept(scene, _digest(on), make)

    def ambient_e_per_s(self) -> Image:
        """Noise-free electrons per second of the ambient light, (H, W), read-only."""
        return self._ambient(self._scene)

    def _ambient(self, scene: Scene) -> Image:
        return self._kept(scene, b"ambient", lambda: self._traced(scene).ambient)

    def _kept(self, scene: Scene, what: bytes, make: Callable[[], Image]) -> Image:
        """Return an image from the cache, made first where it is not in it."""
        with self._render_lock:
            key = (*scene.key, what)
            if key not in self._frames:
                self._frames[key] = make()
                self._frames[key].flags.writeable = False
                if len(self._frames) > CACHED_FRAMES:
                    self._frames.popitem(last=False)
            self._frames.move_to_end(key)
            return self._frames[key]

    def expose(
        self, parts: Iterable[tuple[Mirrors, float]], exposure_s: float, frame_number: int
    ) -> NDArray[np.uint8] | NDArray[np.uint16]:
        """Return the camera's frame: light of all parts of the exposure, noise, clip, DN.

        Parameters
        ----------
        parts : iterable of (mirrors, seconds)
            What the DMD showed while the shutter was open, and how long; black in between.
        exposure_s : float
            Time that the shutter was open: ambient light is integrated over it.
        frame_number : int
            Not negative. The same number, seed and scene give the same frame, bit by bit.

        Returns
        -------
        ndarray, (H, W)
            uint8, or uint16 for 10 and 12 bits.
        """
        scene = self._scene
        lights = [(self._ambient(scene), exposure_s)]
        lights += [(self._projected(scene, mirrors), seconds) for mirrors, seconds in parts]
        return self._digitised(lights, frame_number)

    def _digitised(
        self, lights: list[tuple[Image, float]], frame_number: int
    ) -> NDArray[np.uint8] | NDArray[np.uint16]:
        optics, electrons = self.optics, np.empty_like(lights[0][0])
        dtype = np.uint8 if optics.bits == 8 else np.uint16
        out: NDArray[np.uint8] | NDArray[np.uint16] = np.empty(electrons.shape, dtype=dtype)
        sensor = photons.Sensor(optics.dn_per_e, optics.read_noise_e, float(optics.max_dn))
        key = np.uint64(photons.frame_key(np.uint64(optics.seed), np.uint64(frame_number)))

        def work(rows: tuple[int, int]) -> None:
            _integrate(lights, electrons[slice(*rows)], slice(*rows))
            photons.digitise(electrons, rows, sensor, key, out)

        in_strips(work, out.shape[0])
        return out

    def _traced(self, scene: Scene) -> Geometry:
        """Geometry of a scene; the last one is kept."""
        if self._geometry is None or self._geometry[0] != scene.key:
            self._geometry = None  # its maps are about to be written over
            self._geometry = (scene.key, self._trace(scene))
        return self._geometry[1]

    def _trace(self, scene: Scene) -> Geometry:
        light = shading.light_data(self.rig, self.optics, scene.finish)
        margin = self._weights.shape[1] // 2
        view = self._view(scene)
        width, height = self.rig.camera.image_size
        shape = (2 * (height + 2 * margin), 2 * (width + 2 * margin))
        if self._maps is None:  # 31 MB each: fresh pages at every pose would cost a third of it
            self._maps = tuple(np.empty(shape, dtype=np.float32) for _ in range(6))
        maps = self._maps
        in_strips(lambda r: shading.trace_rows(view, light, margin, r, maps), shape[0])
        u, v, lit, ambient, along_u, along_v = maps
        plain = np.empty((height, width), dtype=np.float32)
        lens = self._lens(self.optics.ambient)
        in_strips(lambda r: stripes.render_plain(ambient, lens, r, plain), height)
        in_strips(lambda r: shading.blur_rows(maps, r), shape[0])
        levels = (_levels(along_u, lit, self.optics), _levels(along_v, lit, self.optics))
        return Geometry(stripes.Samples(u, v, lit, along_u, along_v), levels, plain)

    def _render(self, geometry: Geometry, on: NDArray[np.bool_]) -> Image:
        width, height = self.rig.camera.image_size
        out = np.zeros((height, width), dtype=np.float32)
        if not on.any():
            return out
        if (on[0] == on).all():
            self._render_lines(geometry, 0, on[0], out)
        elif (on[:, :1] == on).all():
            self._render_lines(geometry, 1, on[:, 0], out)
        else:
            self._render_mirrors(geometry, on, out)
        return out

    def _render_lines(
        self, geometry: Geometry, axis: int, profile: NDArray[np.bool_], out: Image
    ) -> None:
        maps, levels = geometry.maps, geometry.levels
        if axis == 1:
            u, v, lit, along_u, along_v = maps
            maps, levels = stripes.Samples(v, u, lit, along_v, along_u), levels[::-1]
        across, reach = self.rig.projector.image_size[1 - axis], levels[1].reach
        pattern = stripes.Stripes(
            stripes.blurred_line(np.ascontiguousarray(profile), levels[0]),
            stripes.blurred_line(np.ones(across, dtype=np.bool_), levels[1]),
            levels,
            (reach - 0.5, across - reach - 0.5),
        )
        lens = self._lens()
        in_strips(lambda r: stripes.render_lines(maps, pattern, lens, r, out), out.shape[0])

    def _render_mirrors(self, geometry: Geometry, on: NDArray[np.bool_], out: Image) -> None:
        ru, rv = (2 * levels.reach for levels in geometry.levels)
        mirrors = np.pad(on, ((rv, rv), (ru, ru))).astype(np.float32)
        image, lens = stripes.MirrorImage(mirrors, geometry.levels), self._lens()
        in_strips(
            lambda r: stripes.render_mirrors(geometry.maps, image, lens, r, out), out.shape[0]
        )

    def _lens(self, light: float = 1.0) -> stripes.Lens:
        """From samples to electrons per second, at a brightness relative to white."""
        return stripes.Lens(self._weights, np.float32(self.optics.white_e_per_s * light))

    # -- truth -----------------------------------------------------------------------------

    def truth_points(self, q_px: Array) -> Array:
        """First intersections (N, 3), world, of the camera rays through pixels (N, 2).

        NaN where a ray meets nothing.
        """
        scene = self._scene
        part = truth.points(self._view(scene), _pixels(q_px))
        return np.asarray(part @ scene.rotation.T + scene.translation_m)

    def truth_lit(self, q_px: Array) -> NDArray[np.bool_]:
        """Whether the projector lights what pixels (N, 2) see: inside the DMD, not in shadow."""
        return truth.lit(self._view(self._scene), _pixels(q_px))

    def truth_edges(self, boundaries: Array, line_px: float, axis: Axis = "column") -> Array:
        """Camera u (K,) of DMD column boundaries along a camera row, or v of row boundaries.

        Parameters
        ----------
        boundaries : ndarray, (K,)
            Boundary k lies at DMD coordinate k - 0.5.
        line_px : float
            The camera row; for row boundaries the camera column.
        axis : {"column", "row"}
            Of the boundaries.

        Returns
        -------
        ndarray, (K,)
            Camera px; NaN where the boundary is not in view. The first crossing where there are
            several; shadow is not looked at (see `truth_lit`).
        """
        k = 0 if axis == "column" else 1
        targets = np.atleast_1d(np.asarray(boundaries, dtype=np.float64)) - 0.5
        length = self.rig.camera.image_size[k]
        return truth.crossings(self._view(self._scene), k, targets, line_px, length)

    def edge_blur_px(self, q_px: Array, axis: Axis = "column") -> Array:
        """Standard deviation (N,) of a stripe's edge at pixels (N, 2), camera px.

        Along the camera row for column stripes, along the camera column for row stripes:
        ``sqrt(lens^2 + (projector / |grad|)^2 + 1/12) |grad| / |grad along the line|``, where grad
        is the gradient of the DMD coordinate over the camera's pixels. NaN where a ray meets
        nothing.

        Parameters
        ----------
        q_px : ndarray, (N, 2)
            Camera pixels.
        axis : {"column", "row"}
            Axis of the stripes.
        """
        k, q, o = 0 if axis == "column" else 1, _pixels(q_px), self.optics
        view = self._view(self._scene)
        found, slope = truth.projector_map(view, q), truth.gradients(view, k, q)
        focus_m = [d.translation_m[2] for d in (self.rig.projector, self.rig.camera)]
        off_focus = found[:, 2:] - focus_m
        projector2 = o.projector_blur_px**2 + (o.projector_defocus_px_per_m * off_focus[:, 0]) ** 2
        lens2 = o.lens_blur_px**2 + (o.lens_defocus_px_per_m * off_focus[:, 1]) ** 2
        steep2 = np.sum(slope**2, axis=1)
        across = np.sqrt(lens2 + projector2 / steep2 + 1.0 / 12.0)
        return np.asarray(across * np.sqrt(steep2) / np.abs(slope[:, k]))

    def _view(self, scene: Scene) -> raycast.View:
        pose = (scene.rotation, scene.translation_m)
        camera, projector = (
            raycast.device_data(d, *pose) for d in (self.rig.camera, self.rig.projector)
        )
        return raycast.View(scene.surface.data, camera, projector)


def _finish(finish: Finish | str) -> Finish:
    return make_finish(finish) if isinstance(finish, str) else finish


def _difference(white: Image, part: Image) -> Image:
    """Light of the mirrors that are off in a part of the white image."""
    out = np.empty_like(white)

    def work(rows: tuple[int, int]) -> None:
        strip = slice(*rows)
        np.subtract(white[strip], part[strip], out=out[strip])
        np.maximum(out[strip], np.float32(0.0), out=out[strip])

    in_strips(work, out.shape[0])
    return out


def _integrate(lights: list[tuple[Image, float]], electrons: Image, strip: slice) -> None:
    """Electrons of some rows: the sum of each light over its seconds."""
    electrons[...] = 0.0
    for light, seconds in lights:
        electrons += light[strip] * np.float32(seconds)


def _digest(on: NDArray[np.bool_]) -> bytes:
    return hashlib.blake2b(np.packbits(on).data, digest_size=16).digest()


def _pixels(q_px: Array) -> Array:
    return np.ascontiguousarray(np.atleast_2d(np.asarray(q_px, dtype=np.float64)))


def _levels(variance: Image, lit: Image, optics: Optics) -> stripes.Levels:
    """Blur levels over the lit samples of a map."""
    found: list[tuple[float, float]] = []
    in_strips(lambda r: found.append(shading.variance_range(variance, lit, r)), lit.shape[0])
    low, high = min(f[0] for f in found), max(f[1] for f in found)
    return stripes.blur_levels(*((low, high) if high > 0.0 else (optics.projector_blur_px**2,) * 2))
