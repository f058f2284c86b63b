"""Draw what radars reported beside the tracks made of it.

    python examples/plots_and_tracks.py OUTPUT PICTURE.png

OUTPUT is a folder that `saltus demo` wrote.
"""

import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pyarrow.parquet as pq
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from saltus.config import load_config
from saltus.geo import Plane, Site, polar_to_plane
from saltus.io import read
from saltus.report.colours import colour_map

INK, GREY, RING = "#1c2430", "#6b7480", "#e3e7eb"
RANGES_NM = (20, 40, 60)
EAST, NORTH = (-112.0, 140.0), (-107.0, 107.0)  # km

Array = npt.NDArray[np.float64]


def main(output: Path, picture: Path) -> None:
    """Draw one picture of two panels."""
    missing = [n for n in ("sensors.toml", "tracks.parquet", "radar_*.ast") if not list(output.glob(n))]
    if missing:
        sys.exit(f"{output}: no {missing[0]} in it; name a folder that saltus demo wrote (saltus demo -o FOLDER).")
    config = load_config(output / "sensors.toml")
    sites = [
        Site(np.radians(s.latitude), np.radians(s.longitude), 0.0 if s.height is None else s.height)
        for s in config.sensor
    ]
    plane = Plane(float(np.mean([s.latitude for s in sites])), float(np.mean([s.longitude for s in sites])))
    names = [s.name for s in config.sensor]
    with rc_context({"font.family": "DejaVu Sans", "font.size": 9.5, "text.color": INK}):
        figure = Figure(figsize=(11.0, 5.4), dpi=160, facecolor="white")
        left = figure.add_axes((0.006, 0.075, 0.49, 0.84))
        right = figure.add_axes((0.504, 0.075, 0.49, 0.84))
        n = draw_plots(left, output, sites, plane)
        n_tracks = draw_tracks(right, output, plane)
        for axes in (left, right):
            draw_map(axes, sites, names, plane)
        left.set_title(f"{n:,} plots of two radars in ten minutes".replace(",", " "), loc="left", weight="bold")
        right.set_title(f"{n_tracks} tracks, coloured by P(horizontal manoeuvre)", loc="left", weight="bold")
        draw_scale(figure)
        figure.savefig(picture, metadata={"Software": None})


def draw_plots(axes: Axes, output: Path, sites: list[Site], plane: Plane) -> int:
    """Draw every plot alike; return their number."""
    plots = read(sorted(output.glob("radar_*.ast"))).plots
    for k, site in enumerate(sites):
        own = plots.take(plots.source == k)
        at = polar_to_plane(
            own.range,
            own.azimuth,
            own.altitude,
            site,
            plane,
            sigma_range=30.0,
            sigma_azimuth=1e-3,
            sigma_altitude=10.0,
        )
        axes.plot(*(at.xy.T / 1e3), ".", color=INK, markersize=1.9, markeredgewidth=0.0, alpha=0.8)
    return len(plots)


def draw_tracks(axes: Axes, output: Path, plane: Plane) -> int:
    """Draw confirmed tracks; return their number."""
    table = pq.read_table(output / "tracks.parquet")
    ids, p = table["track_id"].to_numpy(), table["p_manoeuvre_h"].to_numpy()
    latitude, longitude = (np.radians(table[name].to_numpy()) for name in ("latitude", "longitude"))
    xy = plane.forward(latitude, longitude) / 1e3
    colours = LinearSegmentedColormap.from_list("probability", colour_map())
    for track_id in np.unique(ids):
        at = np.flatnonzero(ids == track_id)
        pieces = np.stack([xy[at[:-1]], xy[at[1:]]], axis=1)
        lines = LineCollection(list(pieces), cmap=colours, linewidths=2.1, capstyle="round")
        lines.set_array(0.5 * (p[at[:-1]] + p[at[1:]]))
        lines.set_clim(0.0, 1.0)
        axes.add_collection(lines)
        axes.plot(*xy[at[-1]], "o", color=INK, markersize=3.2, markeredgewidth=0.0)
    return len(np.unique(ids))


def draw_map(axes: Axes, sites: list[Site], names: list[str], plane: Plane) -> None:
    """Draw sites and range rings on a bare map."""
    angle = np.linspace(0.0, 2.0 * np.pi, 181)
    for site, name in zip(sites, names, strict=True):
        x, y = plane.forward(site.latitude, site.longitude) / 1e3
        for radius in RANGES_NM:
            r = 1.852 * radius
            axes.plot(x + r * np.cos(angle), y + r * np.sin(angle), color=RING, linewidth=0.7, zorder=0)
        axes.plot(x, y, "^", color=INK, markersize=6.5, markeredgecolor="white", zorder=3)
        label = axes.text(x + 3.5, y + 2.5, name, fontsize=8.5, weight="bold", zorder=3)
        label.set_bbox({"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 0.8})
    axes.set(xlim=EAST, ylim=NORTH, aspect="equal", xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set(color="#c9d0d7", linewidth=0.8)


def draw_scale(figure: Figure) -> None:
    """Draw the length scale at the left and the colours at the right, under the panels."""
    share = 0.49 * 50.0 / (EAST[1] - EAST[0])
    bar = figure.add_axes((0.006, 0.036, share, 0.0105))
    bar.set(xticks=[], yticks=[], facecolor=INK)
    figure.text(0.012 + share, 0.041, "50 km; rings every 20 NM", color=GREY, fontsize=8.5, va="center")
    ramp = figure.add_axes((0.824, 0.034, 0.14, 0.0165))
    ramp.imshow(np.linspace(0, 1, 256)[None], cmap=LinearSegmentedColormap.from_list("p", colour_map()), aspect="auto")
    ramp.set(xticks=[], yticks=[])
    for axes in (bar, ramp):
        for spine in axes.spines.values():
            spine.set_visible(False)
    figure.text(0.818, 0.041, "steady 0", color=GREY, fontsize=8.5, va="center", ha="right")
    figure.text(0.970, 0.041, "1", color=GREY, fontsize=8.5, va="center")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: python examples/plots_and_tracks.py OUTPUT PICTURE.png")
    main(Path(sys.argv[1]), Path(sys.argv[2]))
