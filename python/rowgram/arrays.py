"""Single steps on NumPy arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _rowgram
from ._errors import InputError

if TYPE_CHECKING:
    import pandas


@dataclass(frozen=True)
class Vegetation:
    """The vegetation of a picture.

    Attributes:
        mask: Leaf pixels, shape (rows, columns).
        posterior: Probability of vegetation of each pixel, shape (rows, columns); ``None`` with thresholds.
    """

    mask: NDArray[np.bool_]
    posterior: NDArray[np.float32] | None


def segment(image: ArrayLike, *, hsv: Sequence[int] | None = None) -> Vegetation:
    """Find the vegetation of a picture.

    Args:
        image: Colours, ``uint8``, shape (rows, columns, 3) in the order red, green, blue.
        hsv: The paper's four thresholds in 8-bit HSV (hue from, hue to, least saturation, least value). Without
            them classes of colour are estimated from the picture itself.

    Raises:
        InputError: An array of another kind, thresholds beyond their limits.
    """
    mask, posterior = _rowgram.segment(np.asarray(image), None if hsv is None else list(hsv))
    return Vegetation(mask, posterior)


def spectral_index(index: str, /, **bands: ArrayLike) -> NDArray[np.float32]:
    """Compute a spectral index of every pixel.

    Args:
        index: A known index (``ndvi``, ``ndre``, ``gndvi``, ``savi``, ``osavi``, ``evi2``, ``ci_green``, ``ci_red_edge``) or a
            formula of bands, ``(nir - red) / (nir + red)``.
        **bands: Reflectances from 0 to 1 of ``blue``, ``green``, ``red``, ``red_edge``, ``nir``, as many as the index needs; all of
            one shape, which the result has too. NaN where there are no data.

    Raises:
        InputError: A word that is no index, a band that is missing, arrays of different shapes.
    """
    arrays = [np.asarray(values, dtype=np.float32) for values in bands.values()]
    shapes = {values.shape for values in arrays}
    if len(shapes) != 1:
        raise InputError(f"bands: expected arrays of one shape, not {sorted(shapes)}")
    samples = np.stack([values.ravel() for values in arrays], axis=-1)
    return _rowgram.spectral_index(index, list(bands), samples).reshape(arrays[0].shape)


@dataclass(frozen=True)
class Plants:
    """The plants of a leaf mask.

    Attributes:
        positions_px: ``(u, v)`` of each plant, shape (plants, 2).
        confidence: Probability that a plant stands there, shape (plants,); ``None`` for methods that do not know it.
        row: Number of the row of each plant, shape (plants,); ``None`` likewise.
        details: What else the method knows: ``count_interval``, ``spacing_px``, ``row_spacing_px``, ``missing_px``,
            ``sigma_along_px``, ``final_cost`` and so on.
    """

    positions_px: NDArray[np.float64]
    confidence: NDArray[np.float64] | None
    row: NDArray[np.int64] | None
    details: dict[str, Any]

    def __len__(self) -> int:
        return len(self.positions_px)

    def to_pandas(self) -> pandas.DataFrame:
        """One line per plant."""
        import pandas

        columns: dict[str, Any] = {"u_px": self.positions_px[:, 0], "v_px": self.positions_px[:, 1]}
        columns |= {"confidence": self.confidence, "row": self.row} | self.details
        fits = {k: v for k, v in columns.items() if isinstance(v, np.ndarray) and v.shape == (len(self),)}
        return pandas.DataFrame(fits)


def locate(mask: ArrayLike, plants: int | None = None, *, gsd_m: float | None = None, **options: Any) -> Plants:
    """Find the plants of a leaf mask.

    Args:
        mask: Leaf pixels, ``bool`` or ``uint8`` (not 0 is leaf), shape (rows, columns).
        plants: Number of plants; found from the mask where not given.
        gsd_m: Ground sampling distance, metres per pixel.
        **options: Options of the section ``locate`` of ``rowgram.toml`` (``rowgram.options("locate")`` lists them):
            ``method="paper"``, ``prior="rows"``, ``seed=1`` and so on.

    Raises:
        InputError: An array of another kind, an option that does not exist or cannot have this value.
    """
    found = _rowgram.locate(np.asarray(mask), options | {"plants": plants, "gsd_m": gsd_m})
    positions = found.pop("positions_px")
    return Plants(positions, found.pop("confidence", None), found.pop("row", None), found)


@dataclass(frozen=True)
class Leaves:
    """The single leaves of a leaf mask; arrays have one entry per leaf.

    Attributes:
        labels: Number of the leaf of each pixel plus 1, 0 elsewhere, shape (rows, columns).
        length_px: Length along the axis.
        width_px: Mean width across the axis.
        area_px: Pixels.
        angle_rad: Direction of the axis, from the ``u`` axis towards the ``v`` axis, 0 to pi.
        middle_px: ``(u, v)`` of the middle of the axis, shape (leaves, 2).
        axes_px: The axis of each leaf, arrays of shape (points, 2).
        usual_width_px: The usual width of a leaf.
    """

    labels: NDArray[np.int32]
    length_px: NDArray[np.float64]
    width_px: NDArray[np.float64]
    area_px: NDArray[np.float64]
    angle_rad: NDArray[np.float64]
    middle_px: NDArray[np.float64]
    axes_px: list[NDArray[np.float64]]
    usual_width_px: float

    def __len__(self) -> int:
        return len(self.length_px)

    def to_pandas(self) -> pandas.DataFrame:
        """One line per leaf."""
        import pandas

        names = ["length_px", "width_px", "area_px", "angle_rad"]
        columns = {"u_px": self.middle_px[:, 0], "v_px": self.middle_px[:, 1]}
        return pandas.DataFrame(columns | {name: getattr(self, name) for name in names})


def leaves(mask: ArrayLike, **options: Any) -> Leaves:
    """Measure every leaf of a leaf mask.

    Args:
        mask: Leaf pixels, ``bool`` or ``uint8``, shape (rows, columns).
        **options: Options of the section ``leaves`` of ``rowgram.toml``: ``bridging="greedy"`` and so on.

    Raises:
        InputError: An array of another kind, an option that does not exist or cannot have this value.
    """
    return Leaves(**_rowgram.find_leaves(np.asarray(mask), options))


@dataclass(frozen=True)
class Score:
    """Found positions compared with true ones, matched one to one.

    Attributes:
        truth: Number of true positions.
        found: Number of found positions.
        count_error: ``found - truth``.
        median_error_px: Median distance of the pairs at the largest radius; ``None`` without a pair.
        rms_error_px: Root of the mean squared distance of the same pairs.
        radii: One dictionary per radius: ``radius_px``, ``precision``, ``recall``, ``f1``.
    """

    truth: int
    found: int
    count_error: int
    median_error_px: float | None
    rms_error_px: float | None
    radii: list[dict[str, float | None]]


def evaluate(found: ArrayLike, true: ArrayLike, radii: Sequence[float]) -> Score:
    """Compare found with true positions.

    Args:
        found: ``(u, v)`` in pixels, shape (n, 2).
        true: Likewise, shape (m, 2).
        radii: Largest distances in pixels at which a found position may stand for a true one.

    Raises:
        InputError: Arrays of another shape, positions that are not finite, no radius or one that is not positive.
    """
    return Score(**_rowgram.evaluate(found, true, [float(radius) for radius in np.atleast_1d(radii)]))


def sift(image: ArrayLike, **options: Any) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Find the SIFT features of a picture.

    Args:
        image: Grey values, ``uint8``, shape (rows, columns), or colours, shape (rows, columns, 3).
        **options: ``max_features``, ``upscale`` ("precise", "half-pixel", "none"), ``norm`` ("root", "l2"),
            ``contrast_threshold``, ``edge_threshold``.

    Returns:
        Key points, shape (n, 5): ``u_px, v_px, sigma_px, angle_rad, response``; and descriptors, shape (n, 128).
    """
    return _rowgram.sift(np.asarray(image), options)


def match(first: ArrayLike, second: ArrayLike, **options: Any) -> NDArray[np.uint32]:
    """Match the descriptors of two pictures.

    Args:
        first: Descriptors, ``uint8``, shape (n, 128).
        second: Likewise, shape (m, 128).
        **options: ``ratio``, ``max_distance``, ``mutual``.

    Returns:
        Indices in the first and the second set, shape (matches, 2).
    """
    return _rowgram.match_descriptors(np.asarray(first), np.asarray(second), options)
