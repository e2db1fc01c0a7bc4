"""Single steps on arrays, and what is said about arrays that cannot be used."""

import numpy as np
import pytest

import rowgram


def test_plants_of_a_field_are_found(field):
    plants = rowgram.locate(field.mask, gsd_m=field.gsd_m)
    score = rowgram.evaluate(plants.positions_px, field.plants_px, radii=[0.05 / field.gsd_m, 0.10 / field.gsd_m])
    assert score.truth == len(field.plants_px)
    assert score.radii[1]["f1"] > 0.85
    assert len(plants.confidence) == len(plants) == len(plants.to_pandas())
    low, high = plants.details["count_interval"]
    assert low < high


def test_the_number_of_plants_can_be_given(field):
    count = len(field.plants_px)
    plants = rowgram.locate(field.mask, plants=count, method="kmeans", seed=4)
    assert plants.positions_px.shape == (count, 2)
    again = rowgram.locate(field.mask, plants=count, method="kmeans", seed=4)
    assert np.array_equal(plants.positions_px, again.positions_px)


def test_masks_may_be_views_and_of_either_type(field):
    expected = rowgram.locate(field.mask).positions_px
    as_bytes = 255 * field.mask.astype(np.uint8)
    assert np.array_equal(rowgram.locate(as_bytes).positions_px, expected)
    padded = np.zeros((field.mask.shape[0], 2 * field.mask.shape[1]), bool)
    padded[:, ::2] = field.mask
    assert np.array_equal(rowgram.locate(padded[:, ::2]).positions_px, expected)


def test_vegetation_is_found(field):
    found = rowgram.segment(field.image)
    assert found.mask.shape == field.mask.shape == found.posterior.shape
    overlap = (found.mask & field.mask).sum() / (found.mask | field.mask).sum()
    assert overlap > 0.8
    thresholds = rowgram.segment(field.image, hsv=[30, 79, 30, 163])
    assert thresholds.posterior is None and thresholds.mask.dtype == bool


def test_leaves_are_measured(field):
    found = rowgram.leaves(field.mask)
    assert len(found) == found.labels.max() > len(field.plants_px)
    assert np.array_equal(found.labels > 0, field.mask)
    sizes = np.bincount(found.labels.ravel())[1:]
    assert np.array_equal(sizes, found.area_px)
    assert len(found.to_pandas()) == len(found.axes_px) == len(found)


def test_features_of_a_shifted_picture_match(field):
    grey = field.image.mean(axis=2).astype(np.uint8)
    points, descriptors = rowgram.sift(grey, max_features=800)
    assert points.shape[1] == 5 and descriptors.shape == (len(points), 128)
    moved_points, moved = rowgram.sift(np.ascontiguousarray(grey[7:, 11:]), max_features=800)
    pairs = rowgram.match(descriptors, moved)
    assert len(pairs) > 50
    shift = points[pairs[:, 0], :2] - moved_points[pairs[:, 1], :2]
    assert np.allclose(np.median(shift, axis=0), [11, 7], atol=0.05)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: rowgram.locate(np.zeros((4, 4, 3), np.uint8)), "mask: expected an array of bool or uint8"),
        (lambda: rowgram.locate(np.zeros((4, 4))), "float64"),
        (lambda: rowgram.locate("mask.png"), "mask: expected"),
        (lambda: rowgram.locate(np.ones((4, 4), bool), plnts=3), "did you mean plants|plants"),
        (lambda: rowgram.locate(np.ones((4, 4), bool), method="magic"), "row-model"),
        (lambda: rowgram.locate(np.ones((4, 4), bool), plants=0), "plants"),
        (lambda: rowgram.segment(np.zeros((4, 4), np.uint8)), r"shape \(rows, columns, 3\)"),
        (lambda: rowgram.segment(np.zeros((0, 0, 3), np.uint8)), "expected pixels"),
        (lambda: rowgram.leaves(np.ones((4, 4), bool), bridging="glue"), "global"),
        (lambda: rowgram.evaluate([[0.0, 1.0, 2.0]], [[0.0, 1.0]], [1.0]), r"shape \(n, 2\)"),
        (lambda: rowgram.evaluate([[np.nan, 1.0]], [[0.0, 1.0]], [1.0]), "finite"),
        (lambda: rowgram.evaluate([[0.0, 1.0]], [[0.0, 1.0]], [-1.0]), "positive"),
        (lambda: rowgram.sift(np.zeros((4, 4), np.uint8), max_feature=3), "did you mean max_features"),
        (lambda: rowgram.match(np.zeros((3, 64), np.uint8), np.zeros((3, 128), np.uint8)), "first"),
        (lambda: rowgram.synth.field("mid21"), "mid20"),
        (lambda: rowgram.synth.field("mid20", spaceing_m=0.2), "spacing_m"),
    ],
)
def test_what_cannot_be_is_refused(call, message):
    with pytest.raises(rowgram.InputError, match=message):
        call()


def test_nothing_is_an_answer():
    empty = np.zeros((40, 60), bool)
    assert len(rowgram.leaves(empty)) == 0
    assert rowgram.evaluate(np.zeros((0, 2)), [[1.0, 1.0]], [2.0]).radii[0]["recall"] == 0.0
    points, descriptors = rowgram.sift(np.zeros((40, 60), np.uint8))
    assert len(points) == 0 and len(rowgram.match(descriptors, descriptors)) == 0


def test_spectral_indices_are_of_bands_by_name():
    red, nir = np.full((2, 3), 0.05), np.full((2, 3), 0.45)
    nir[0, 0] = np.nan
    ndvi = rowgram.spectral_index("ndvi", nir=nir, red=red)
    assert ndvi.shape == (2, 3) and np.isnan(ndvi[0, 0]) and ndvi[1, 2] == pytest.approx(0.8)
    same = rowgram.spectral_index("(nir - red_edge) / (nir + red_edge)", red_edge=red, nir=nir)
    assert np.array_equal(same, ndvi, equal_nan=True)
    for index, bands in [("ndwvi", {"red": red}), ("ndvi", {"red": red}), ("ndvi", {"red": red, "nir": nir[0]})]:
        with pytest.raises(rowgram.InputError):
            rowgram.spectral_index(index, **bands)
