"""Synthetic fields and flights with their whole ground truth."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import _rowgram
from .project import Progress


@dataclass(frozen=True)
class Field:
    """A field from straight above.

    Attributes:
        mask: Leaf pixels, shape (rows, columns).
        image: Colours, ``uint8``, shape (rows, columns, 3).
        plants_px: True ``(u, v)`` of each stalk, shape (plants, 2).
        plants_m: The same in metres, X east and Y north.
        row: The row of each plant, shape (plants,).
        gsd_m: Ground sampling distance, metres per pixel.
        config: Every parameter.
    """

    mask: NDArray[np.bool_]
    image: NDArray[np.uint8]
    plants_px: NDArray[np.float64]
    plants_m: NDArray[np.float64]
    row: NDArray[np.int64]
    gsd_m: float
    config: dict[str, Any]


def field(preset: str = "mid20", *, corruption: dict[str, Any] | None = None, **parameters: Any) -> Field:
    """Grow a field.

    Args:
        preset: A usual field by name: growth stage and spacing in centimetres ("early20", "mid12", "late30", ...).
        corruption: What spoils its picture: ``{"weeds_per_m2": 2.0}`` and so on.
        **parameters: Parameters of the field: ``seed``, ``rows``, ``row_length_m``, ``spacing_m``, ``stage`` ...

    Raises:
        InputError: A preset or parameter that does not exist or cannot have this value.
    """
    return Field(**_rowgram.synth_field(preset, parameters, corruption))


def map(
    folder: str | os.PathLike[str],
    preset: str = "mid20",
    *,
    corruption: dict[str, Any] | None = None,
    samples: str = "u16",
    force: bool = False,
    **parameters: Any,
) -> dict[str, Any]:
    """Write an orthomosaic of five bands of known reflectance, with plots, as a project folder with its truth below ``truth/``.

    Args:
        folder: Folder to write into, made if missing.
        preset: A usual field by name, as of :func:`field`.
        corruption: What spoils its picture.
        samples: "u16" (reflectance times 10,000) or "float".
        force: Whether files that exist are replaced.
        **parameters: Parameters of the field; ``plots={"rows": 2, "length_m": 5.0, "alley_m": 1.0}`` divides it.

    Returns:
        Numbers of ``plants`` and ``plots``, and ``size_px``.

    Raises:
        InputError: A preset or parameter that does not exist or cannot have this value, a file that exists.
    """
    return _rowgram.synth_map(os.fspath(folder), preset, parameters, corruption, samples, force)


def flight(
    folder: str | os.PathLike[str],
    preset: str = "small",
    *,
    photos: bool = True,
    photo_truth: bool = False,
    boards: int = 0,
    force: bool = False,
    progress: Progress | None = None,
    **sections: dict[str, Any],
) -> dict[str, int]:
    """Fly over a synthetic field and write a project folder, with all its truth below ``truth/``.

    Args:
        folder: Folder to write into, made if missing.
        preset: "small", "paper" or "seneca".
        photos: Whether photos are made; everything else is there in seconds.
        photo_truth: Whether the truth of every photo is written too.
        boards: Number of photos of a chessboard for calibration.
        force: Whether files that exist are replaced.
        progress: Called while photos are made.
        **sections: Parameters by section: ``field={"seed": 2, "stage": "late"}, flight={"height_m": 20.0}``.

    Returns:
        Numbers of ``plants``, ``photos``, ``targets`` and ``marks``.
    """
    return _rowgram.synth_flight(
        os.fspath(folder), preset, sections, photos, photo_truth, boards, force, progress
    )
