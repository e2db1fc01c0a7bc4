"""The picture of docs/guide.md: an orthomosaic of five bands, its NDVI, and the NDVI of plots against the truth.

    rowgram synth map --rows 8 --row-length 11 --plot-rows 2 --plot-length 5 --alley 1 --gsd 0.02 --seed 2 -o field
    rowgram run field
    python data-synth/scripts/bands.py field docs/bands.png

Needs numpy, tifffile, imagecodecs and matplotlib.
"""

import csv
import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import tifffile

project, out = Path(sys.argv[1]), Path(sys.argv[2])
samples = tifffile.imread(project / "ortho.tif").astype(float)
samples[samples == 65535] = np.nan
blue, green, red, _, nir = np.moveaxis(samples / 1e4, -1, 0)
ndvi = (nir - red) / (nir + red)


def plots(path):
    with open(path) as file:
        return {row["plot"]: row for row in csv.DictReader(file)}


true, found = plots(project / "truth/plots.csv"), plots(project / "rowgram/plots/traits.csv")
figure, axes = plt.subplots(1, 3, figsize=(11, 3.4), width_ratios=[1.5, 1.5, 1], layout="constrained")
axes[0].imshow(np.clip(np.nan_to_num(np.stack([red, green, blue], -1), nan=1) / 0.25, 0, 1) ** (1 / 1.8))
axes[0].set_title("red, green, blue", fontsize=9)
shown = axes[1].imshow(ndvi, cmap="BrBG", vmin=0, vmax=0.9)
axes[1].set_title("NDVI", fontsize=9)
figure.colorbar(shown, ax=axes[1], shrink=0.7)
for image in axes[:2]:
    image.set_axis_off()
for column, label in [("ndvi", "all ground"), ("ndvi_leaf", "leaves")]:
    x = [float(true[plot][column]) for plot in true]
    y = [float(found[plot][column]) for plot in true]
    sigma = [2 * float(found[plot][f"{column}_sd"]) for plot in true]
    axes[2].errorbar(x, y, yerr=sigma, fmt="o", ms=3, lw=0.8, label=label)
axes[2].axline((0.5, 0.5), slope=1, color="0.6", lw=0.8, zorder=0)
axes[2].set(xlabel="true NDVI", ylabel="measured, ± 2 standard deviations")
axes[2].legend(fontsize=8)
figure.savefig(out, dpi=90)
