"""The colours of probabilities and heights: straight lines in a perceptually uniform space."""

import numpy as np
import numpy.typing as npt

from saltus.shapes import Float

__all__ = ["HEIGHT_ENDS", "PROBABILITY_ENDS", "colour_map", "oklab_to_srgb", "srgb_to_oklab", "system_colours"]

# (lightness, chroma, hue in degrees) of both ends. Lightness falls along each map, so it survives grey printing and
# every colour vision; on white paper a straight flight stays quiet and a manoeuvre stands out.
PROBABILITY_ENDS = ((0.76, 0.055, 245.0), (0.42, 0.175, 15.0))
HEIGHT_ENDS = ((0.80, 0.095, 165.0), (0.36, 0.115, 275.0))

# Dark enough for white figures on them; always shown with the number of the system, as eight hues are too many.
_SYSTEMS = ("#24476b", "#b35900", "#0b7d7a", "#a8123f", "#6b4f9e", "#5f6b1f", "#7c5138", "#3b78b5")

_LMS_FROM_RGB = np.array(
    [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ]
)
_LAB_FROM_LMS = np.array(
    [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
)


def srgb_to_oklab(rgb: npt.ArrayLike) -> Float[np.ndarray, "*lead 3"]:
    """Convert sRGB in [0, 1], shape (..., 3), to Oklab (lightness, a, b).

    Source: Ottosson (2020), "A perceptual color space for image processing"; sRGB transfer curve of IEC 61966-2-1.
    """
    s = np.asarray(rgb, np.float64)
    linear = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
    lab: npt.NDArray[np.float64] = np.cbrt(linear @ _LMS_FROM_RGB.T) @ _LAB_FROM_LMS.T
    return lab


def oklab_to_srgb(lab: npt.ArrayLike) -> Float[np.ndarray, "*lead 3"]:
    """Convert Oklab, shape (..., 3), to sRGB, clipped to [0, 1]: the inverse of `srgb_to_oklab`."""
    lms = (np.asarray(lab, np.float64) @ np.linalg.inv(_LAB_FROM_LMS).T) ** 3
    linear = np.clip(lms @ np.linalg.inv(_LMS_FROM_RGB).T, 0.0, 1.0)
    srgb: npt.NDArray[np.float64] = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return srgb


def colour_map(
    ends: tuple[tuple[float, float, float], tuple[float, float, float]] = PROBABILITY_ENDS, n: int = 32
) -> list[str]:
    """Return `n` colours `#rrggbb` at equal steps on the straight Oklab line between two (L, C, h) ends."""
    a, b = (np.array([L, C * np.cos(np.radians(h)), C * np.sin(np.radians(h))]) for L, C, h in ends)
    rgb = oklab_to_srgb(a + np.linspace(0.0, 1.0, n)[:, None] * (b - a))
    return ["#" + "".join(f"{round(255 * v):02x}" for v in row) for row in rgb]


def system_colours(n: int) -> list[str]:
    """Return a colour for each of `n` systems; they come again after eight."""
    return [_SYSTEMS[k % len(_SYSTEMS)] for k in range(n)]
