"""Settings of the bench's light path: blur, light, sensor, finish of the part."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sl_common.errors import ConfigError

BITS = (8, 10, 12)
#: The 8-bit scale on which ``white_dn`` and ``read_noise_dn`` are given.
FULL_SCALE_DN = 255.0


def check_ranges(settings: object, where: str, **ranges: tuple[float, float]) -> None:
    """Check numbers among settings.

    Parameters
    ----------
    settings : object
        Has them as attributes.
    where : str
        What they belong to, for the message.
    **ranges
        Least and greatest value of each.

    Raises
    ------
    ConfigError
        When one is out of its range, or NaN.
    """
    for name, (low, high) in ranges.items():
        value = getattr(settings, name)
        if not low <= value <= high:
            raise ConfigError(f"{where}: {name}={value}; expected {low:g} to {high:g}")


@dataclass(frozen=True)
class Optics:
    """The photon chain and the blurs of the bench.

    Parameters
    ----------
    projector_blur_px, lens_blur_px : float
        Gaussian standard deviation in focus, DMD pixels and camera pixels.
    projector_defocus_px_per_m, lens_defocus_px_per_m : float
        Standard deviation added in quadrature per metre off the plane of focus, which is normal
        to the device's axis and holds the world's origin.
    full_well_e : float
        Electrons at the top of the scale, whatever the bits.
    read_noise_dn, white_dn : float
        On the 8-bit scale: read noise, and a lit matt part at the origin after
        ``nominal_exposure_s``.
    nominal_exposure_s : float
        The exposure that ``white_dn`` is for.
    ambient : float
        Light that reaches every part, as a fraction of white.
    uneven_light, vignetting : float
        Fraction lost at the corner of the DMD, of the camera image; quadratic in between.
    bits : {8, 10, 12}
        Of the sensor's output: uint8 or uint16.
    seed : int
        Of all noise.
    """

    projector_blur_px: float = 0.55
    lens_blur_px: float = 0.8
    projector_defocus_px_per_m: float = 100.0
    lens_defocus_px_per_m: float = 100.0
    full_well_e: float = 20_000.0
    read_noise_dn: float = 0.5
    white_dn: float = 190.0
    nominal_exposure_s: float = 1.0 / 30.0
    ambient: float = 0.03
    uneven_light: float = 0.05
    vignetting: float = 0.03
    bits: int = 8
    seed: int = 0

    def __post_init__(self) -> None:
        check_ranges(
            self,
            "optics",
            projector_blur_px=(0.2, 5.0),
            lens_blur_px=(0.2, 5.0),
            projector_defocus_px_per_m=(0.0, 1e5),
            lens_defocus_px_per_m=(0.0, 1e5),
            full_well_e=(100.0, 1e7),
            read_noise_dn=(0.0, 50.0),
            white_dn=(0.0, 1e5),
            ambient=(0.0, 10.0),
            uneven_light=(0.0, 0.9),
            vignetting=(0.0, 0.9),
        )
        if self.bits not in BITS:
            raise ConfigError(f"optics: bits={self.bits}; expected one of {BITS}")

    @property
    def max_dn(self) -> int:
        """Top of the sensor's scale."""
        return (1 << self.bits) - 1

    @property
    def dn_per_e(self) -> float:
        """Gain of the sensor, DN of its own scale per electron."""
        return self.max_dn / self.full_well_e

    @property
    def read_noise_e(self) -> float:
        """Read noise, electrons."""
        return self.read_noise_dn * self.full_well_e / FULL_SCALE_DN

    @property
    def white_e_per_s(self) -> float:
        """Electrons per second of a lit matt part at the origin, without ambient light."""
        return self.white_dn / FULL_SCALE_DN * self.full_well_e / self.nominal_exposure_s


@dataclass(frozen=True)
class Finish:
    """How a part's surface sends light back.

    Parameters
    ----------
    diffuse : float
        Lambertian part, relative to the matt finish.
    specular : float
        Height of the specular lobe, relative to a matt white seen square on.
    lobe_deg : float
        Width of the lobe: it falls as ``exp(-(tan(h) / tan(lobe))^2)`` (Beckmann's slope
        distribution) with the angle h between the normal and the half vector.
    texture : float
        Amplitude of a random reflectance, fraction of ``diffuse``.
    texture_m : float
        Grain of that texture.
    """

    diffuse: float = 1.0
    specular: float = 0.0
    lobe_deg: float = 10.0
    texture: float = 0.0
    texture_m: float = 40e-6

    def __post_init__(self) -> None:
        if min(self.diffuse, self.specular, self.texture) < 0.0 or self.texture > 1.0:
            raise ConfigError(f"{self}; expected no negative reflectance and texture <= 1")
        if not (0.0 < self.lobe_deg < 90.0 and self.texture_m > 0.0):
            raise ConfigError(f"{self}; expected lobe_deg in (0, 90) and texture_m > 0")

    @property
    def lobe_tan(self) -> float:
        """Tangent of the lobe's width."""
        return math.tan(math.radians(self.lobe_deg))


FINISHES: dict[str, Finish] = {
    "matt": Finish(),
    "painted": Finish(diffuse=1.0, texture=0.05),
    # A sheen on it: on the reference rig one side of a flat is saturated.
    "glossy": Finish(diffuse=1.0, specular=4.0, lobe_deg=4.5),
    # On the reference rig a flat's half vector is 8 to 16 degrees off its normal: partly saturated.
    "metal": Finish(diffuse=0.35, specular=6.0, lobe_deg=7.0, texture=0.15, texture_m=25e-6),
}


def make_finish(name: str) -> Finish:
    """Return a finish by name: matt, painted, glossy or metal.

    Raises
    ------
    ConfigError
        When there is no finish of that name.
    """
    if name not in FINISHES:
        raise ConfigError(f"no finish is called {name!r}; expected one of {sorted(FINISHES)}")
    return FINISHES[name]
