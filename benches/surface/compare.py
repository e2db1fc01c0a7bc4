"""How exact a surface is: of synthetic flights against their truth, of real ones against another program's cloud.

    rowgram synth flight --config field.toml -o field
    rowgram run field --until surface
    python3 benches/surface/compare.py twin field [field ...]
    python3 benches/surface/compare.py plants field [field ...]
    python3 benches/surface/compare.py cloud PROJECT/rowgram/surface model.laz

field.toml: that of `rowgram synth flight --preset small --no-photos` with other seed, stage, forward_overlap and side_overlap.

twin: over the middle 60 % of each side of the map, one row for each flight. Soil: robust spread (1.4826 times the
median deviation) of its errors in cells. Leaves: share of cells all round leaf within 5 cm of the true top. Soil beside leaves:
share within 7.5 cm of those within 5 cells of a leaf. Height: 95th percentile of the canopy height model in squares of 2 m over the
true one, mean and standard deviation. Ground: median error where leaves cover it. Known: share of the cells of the middle.
Sigma: 1.4826 times the median absolute error over standard deviation, soil, leaves and ground.

plants (after `rowgram run field --until locate`): F1 of the plants within 5 and 10 cm of the true ones as they are, after the best similarity
(reweighted least squares of matches within 12 cm), and after the median offset of the matches within 1.5 m. The similarity removes errors of the
datum, the median offset also bending of the block.

cloud: the surface against the cloud's highest points in cells of 0.25 m, after the shift in x, y and z that makes
the median difference least, and a tilt: the other program has camera positions of its own. Robust spread and shares within 10 and 50 cm, for cells
whose neighbours in the cloud differ by at most 0.3 m (ground, roofs) and for the others.

Needs numpy, tifffile with imagecodecs, and for clouds laspy with lazrs.
"""

import argparse
import pathlib
import warnings

import numpy as np
import tifffile


def raster(path):
    """Values (NaN where there are none), easting and northing of the first cell's corner, side of a cell."""
    with tifffile.TiffFile(path) as file:
        page = file.pages[0]
        values = page.asarray().astype(float)
        side = page.tags["ModelPixelScaleTag"].value[0]
        tie = page.tags["ModelTiepointTag"].value
        nodata = page.tags.get("GDAL_NODATA")
    if nodata is not None:
        values[values == float(nodata.value.strip("\0 "))] = np.nan
    return values, (tie[3] - tie[0] * side, tie[4] + tie[1] * side), side


def onto(values, corner, side, to_corner, to_side, shape):
    """The nearest values of one grid in the cells of another."""
    rows = np.round((corner[1] - to_corner[1] + (np.arange(shape[0]) + 0.5) * to_side) / side - 0.5).astype(int)
    columns = np.round((to_corner[0] - corner[0] + (np.arange(shape[1]) + 0.5) * to_side) / side - 0.5).astype(int)
    out = np.full(shape, np.nan)
    inside = [(r >= 0) & (r < n) for r, n in zip((rows, columns), values.shape)]
    out[np.ix_(*inside)] = values[np.ix_(rows[inside[0]], columns[inside[1]])]
    return out


def spread(errors):
    errors = errors[np.isfinite(errors)]
    return 1.4826 * np.median(np.abs(errors - np.median(errors))) if errors.size else float("nan")


def ratio(errors):
    return 1.4826 * np.nanmedian(np.abs(errors))


def grown(mask, cells):
    out = mask.copy()
    for _ in range(cells):
        wider = out.copy()
        wider[1:] |= out[:-1]
        wider[:-1] |= out[1:]
        wider[:, 1:] |= out[:, :-1]
        wider[:, :-1] |= out[:, 1:]
        out = wider
    return out


def twin(projects):
    print("| flight | known % | soil, cells | leaves % | soil beside % | height, cm | ground, cm | sigma soil, leaves, ground |")
    print("|---|---|---|---|---|---|---|---|")
    for project in map(pathlib.Path, projects):
        folder = project / "rowgram" / "surface"
        surface, corner, side = raster(folder / "dsm.tif")
        middle = tuple(slice(int(0.2 * n), int(0.8 * n)) for n in surface.shape)
        shape = surface.shape

        def at(path):
            return onto(*raster(path), corner, side, shape)[middle]

        surface = surface[middle]
        top, true_height = at(project / "truth/dsm.tif"), at(project / "truth/chm.tif")
        height, sigma = at(folder / "chm.tif"), at(folder / "dsm_sigma.tif")
        ground_off = at(folder / "dtm.tif") - (top - true_height)
        ground_sigma = at(folder / "dtm_sigma.tif")
        plant = true_height > 0.01
        leaf = ~grown(~plant, 1)
        soil = ~plant & (true_height < 0.005)
        off = surface - top
        beside = soil & grown(plant, 5)

        def within(mask, most):
            return 100 * np.mean(np.abs(off[mask & np.isfinite(top)]) < most)

        step = int(round(2.0 / side))
        differences = []
        for row in range(0, off.shape[0] - step, step):
            for column in range(0, off.shape[1] - step, step):
                square = np.s_[row:row + step, column:column + step]
                mine, true = height[square], true_height[square]
                seen = np.isfinite(mine) & np.isfinite(true)
                if seen.mean() > 0.9 and (true[seen] > 0.01).mean() > 0.02:
                    differences.append(np.percentile(mine[seen], 95) - np.percentile(true[seen], 95))
        known = 100 * np.mean(np.isfinite(surface))
        print(
            f"| {project.name} | {known:.1f} | {spread(off[soil]) / side:.2f} | {within(leaf, 0.05):.0f} "
            f"| {within(beside, 0.075):.0f} | {100 * np.mean(differences):+.1f}, {100 * np.std(differences):.1f} "
            f"| {100 * np.nanmedian(ground_off[plant]):+.1f} "
            f"| {ratio(off[soil] / sigma[soil]):.2f}, {ratio(off[leaf] / sigma[leaf]):.2f}, {ratio(ground_off / ground_sigma):.2f} |"
        )


def matches(found, true, most):
    """Pairs of one found and one true place each, the nearest first."""
    distances = np.hypot(*(found[:, None] - true[None]).transpose(2, 0, 1))
    pairs, used = [], (set(), set())
    for at in np.argsort(distances, axis=None):
        i, j = np.unravel_index(at, distances.shape)
        if distances[i, j] > most:
            break
        if i not in used[0] and j not in used[1]:
            used[0].add(i)
            used[1].add(j)
            pairs.append((i, j))
    return np.array(pairs)


def plants(projects):
    def places(path):
        table = np.genfromtxt(path, delimiter=",", names=True)
        return np.column_stack([table["easting_m"], table["northing_m"]])

    print("| flight | found, true | as they are: 5, 10 cm | after a similarity | after the field of offsets | scale, turn, 1e-3 |")
    print("|---|---|---|---|---|---|")
    for project in map(pathlib.Path, projects):
        found, true = places(project / "rowgram/locate/plants.csv"), places(project / "truth/plants.csv")
        middle = true.mean(axis=0)
        found, true = found - middle, true - middle
        low, high = found.min(axis=0) - 0.1, found.max(axis=0) + 0.1
        true = true[np.all((true > low) & (true < high), axis=1)]

        def scores(found):
            return " ".join(f"{2 * len(matches(found, true, most)) / (len(found) + len(true)):.2f}" for most in (0.05, 0.10))

        i, j = matches(found, true, 0.12).T
        offset, at = found[i] - true[j], true[j]
        # Rows for x and y of shift, scale and turn.
        def design(xy):
            one, none = np.ones(len(xy)), np.zeros(len(xy))
            return np.concatenate([np.column_stack([one, none, xy[:, 0], -xy[:, 1]]), np.column_stack([none, one, xy[:, 1], xy[:, 0]])])

        values, weights = offset.T.ravel(), np.ones(2 * len(at))
        for _ in range(6):
            fit = np.linalg.lstsq(design(at) * weights[:, None], values * weights, rcond=None)[0]
            weights = 1 / np.sqrt(1 + ((values - design(at) @ fit) / 0.03) ** 2)
        moved = found - (design(found) @ fit).reshape(2, -1).T
        near = np.hypot(*(found[:, None] - at[None]).transpose(2, 0, 1)) < 1.5
        field = np.array([np.median(offset[row], axis=0) if row.sum() > 8 else np.zeros(2) for row in near])
        print(
            f"| {project.name} | {len(found)}, {len(true)} | {scores(found)} | {scores(moved)} | {scores(found - field)} "
            f"| {1e3 * fit[2]:+.1f}, {1e3 * fit[3]:+.1f} |"
        )


def cloud(folder, laz, side=0.25):
    import laspy

    surface, corner, cell = raster(pathlib.Path(folder) / "dsm.tif")
    points = laspy.read(laz)
    x, y, z = (np.array(values) for values in (points.x, points.y, points.z))
    corner_m = (x.min(), y.max())
    shape = (int((y.max() - y.min()) / side) + 1, int((x.max() - x.min()) / side) + 1)
    theirs = np.full(shape, -np.inf)
    np.maximum.at(theirs, (((corner_m[1] - y) / side).astype(int), ((x - corner_m[0]) / side).astype(int)), z)
    theirs[~np.isfinite(theirs)] = np.nan

    def off(dx, dy):
        mine = onto(surface, corner, cell, (corner_m[0] + dx, corner_m[1] + dy), side, shape)
        return mine - theirs

    def cost(shift):
        errors = off(*shift)
        errors = errors[np.isfinite(errors)]
        return np.median(np.abs(errors - np.median(errors))) if errors.size > 1000 else np.inf

    best = (0.0, 0.0)
    for step, reach in ((1.0, 6), (0.25, 4), (0.1, 3)):
        tried = [(best[0] + i * step, best[1] + j * step) for i in range(-reach, reach + 1) for j in range(-reach, reach + 1)]
        best = min(tried, key=cost)
    errors = off(*best)
    errors -= np.nanmedian(errors)
    # The rest of a similarity that a nearly level scene shows: a tilt, fitted to what agrees.
    rows, columns = np.nonzero(np.isfinite(errors))
    design = np.column_stack([np.ones(rows.size), rows * side, columns * side])
    values = errors[rows, columns]
    tilt = np.zeros(3)
    for most in (2.0, 1.0, 0.5, 0.3):
        near = np.abs(values - design @ tilt) < most
        tilt = np.linalg.lstsq(design[near], values[near], rcond=None)[0]
    errors[rows, columns] -= design @ tilt
    padded = np.pad(theirs, 1, constant_values=np.nan)
    around = np.stack([padded[1 + j:1 + j + shape[0], 1 + i:1 + i + shape[1]] for j in (-1, 0, 1) for i in (-1, 0, 1)])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        level = np.nanmax(around, axis=0) - np.nanmin(around, axis=0) <= 0.3
    print(f"shift {best[0]:+.2f} {best[1]:+.2f} m, tilt {1000 * tilt[1]:.1f} {1000 * tilt[2]:.1f} mm per m")
    for name, mask in (("level", level), ("steep", ~level)):
        of = errors[mask & np.isfinite(errors)]
        print(
            f"{name}: {of.size} cells, spread {100 * spread(of):.1f} cm, within 10 cm {100 * np.mean(np.abs(of) < 0.1):.0f} %, "
            f"within 50 cm {100 * np.mean(np.abs(of) < 0.5):.0f} %"
        )


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    modes = parser.add_subparsers(dest="mode", required=True)
    of_flights = {"twin": twin, "plants": plants}
    for mode in of_flights:
        modes.add_parser(mode).add_argument("projects", nargs="+")
    of_cloud = modes.add_parser("cloud")
    of_cloud.add_argument("folder")
    of_cloud.add_argument("laz")
    arguments = parser.parse_args()
    if arguments.mode in of_flights:
        of_flights[arguments.mode](arguments.projects)
    else:
        cloud(arguments.folder, arguments.laz)


if __name__ == "__main__":
    main()
