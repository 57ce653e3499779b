"""The pictures of the report, each as one inline SVG text."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.diagnosis.runs.residual_tests import autocorrelation, correlation_band, cross_correlation, cusum_of_squares
from harness.signals import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["Overlay", "Pictures", "ResidualView", "draw", "drawing"]

INK, GREY, GRID = "#1d2733", "#8a94a0", "#e3e7ec"
BEFORE, AFTER, DATA = "#d9622b", "#1769aa", "#9aa5b1"


@dataclass(frozen=True)
class Overlay:
    """Measured output of one validation record with the simulation before and after."""

    label: str
    unit: str
    t: FloatArray
    measured: FloatArray
    before: FloatArray
    after: FloatArray | None


@dataclass(frozen=True)
class ResidualView:
    """Residual of one port against one axis, with the fitted effect on top."""

    axis: str
    unit: str
    x: FloatArray
    before: FloatArray
    after: FloatArray | None
    fitted: FloatArray | None
    residual_unit: str
    port: str
    deviation: float = 0.0
    """Standard deviation of one value, where it is known: drawn as a band about 0."""


@dataclass
class Pictures:
    """All that the figures need; parts that are empty are left out of the report."""

    overlays: list[Overlay] = field(default_factory=list)
    views: list[ResidualView] = field(default_factory=list)
    before: FloatArray | None = None
    after: FloatArray | None = None
    u: FloatArray | None = None
    input_name: str = "u"
    sample_time: float = 1.0
    output_name: str = ""
    isolability: tuple[tuple[str, ...], FloatArray] | None = None
    null: FloatArray | None = None
    observed: Mapping[str, float] = field(default_factory=dict)
    coverage: list[tuple[str, str, FloatArray, FloatArray, FloatArray, FloatArray]] = field(default_factory=list)


def draw(pictures: Pictures) -> dict[str, str]:
    """Return the figures by name: overlay, residual (and its caption), tests, isolability, surrogates, coverage."""
    made: dict[str, str] = {}
    if pictures.overlays:
        made["overlay"] = _overlay(pictures.overlays)
    if pictures.views:
        made["residual"] = _residual(pictures.views)
        made["residual_caption"] = _caption(pictures.views)
    if pictures.before is not None:
        made["tests"] = _tests(pictures)
    if pictures.isolability is not None and len(pictures.isolability[0]) > 1:
        made["isolability"] = _isolability(*pictures.isolability)
    if pictures.null is not None and pictures.null.size:
        made["surrogates"] = _surrogates(pictures.null, pictures.observed)
    if pictures.coverage:
        made["coverage"] = _coverage(pictures.coverage)
    return made


@contextmanager
def drawing(name: str, width: float, height: float) -> Iterator[tuple[Figure, list[str]]]:
    """Make a figure without any global state; its SVG text is appended to the list when the block ends."""
    import matplotlib as mpl
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure as MakeFigure

    style: Any = {
        "font.family": "sans-serif",
        "font.sans-serif": ["DejaVu Sans"],
        "font.size": 9,
        "svg.fonttype": "path",
        "svg.hashsalt": name,
        "axes.edgecolor": GREY,
        "axes.labelcolor": INK,
        "axes.titlesize": 9.5,
        "axes.titlecolor": INK,
        "axes.titlelocation": "left",
        "axes.grid": True,
        "axes.axisbelow": True,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "grid.color": GRID,
        "grid.linewidth": 0.7,
        "xtick.color": GREY,
        "ytick.color": GREY,
        "xtick.labelcolor": INK,
        "ytick.labelcolor": INK,
        "legend.frameon": False,
        "legend.fontsize": 8.5,
        "lines.linewidth": 1.3,
    }
    svg: list[str] = []
    with mpl.rc_context(style):
        figure = MakeFigure(figsize=(width, height), layout="constrained")
        FigureCanvasSVG(figure)
        yield figure, svg
        layout = figure.get_layout_engine()
        assert layout is not None
        layout.execute(figure)
        figure.set_layout_engine("none")  # savefig would draw the whole figure once more to lay it out
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None}, dpi=110, transparent=True)
    whole = text.getvalue()
    svg.append(whole[whole.index("<svg") :])


def _overlay(overlays: Sequence[Overlay]) -> str:
    """Draw measured, before and after, with the error below."""
    shown = overlays[:4]
    with drawing("overlay", 10.5, 2.9 * len(shown)) as (figure, svg):
        axes = figure.subplots(len(shown), 2, squeeze=False, width_ratios=(1.6, 1.0))
        for (left, right), one in zip(axes, shown, strict=True):
            pick = _thin(one.t.size, 2500)
            left.plot(one.t[pick], one.measured[pick], color=INK, lw=2.6, alpha=0.28, label="measured")
            left.plot(one.t[pick], one.before[pick], color=BEFORE, lw=1.1, label="before")
            right.plot(one.t[pick], (one.measured - one.before)[pick], color=BEFORE, lw=0.9, label="before")
            if one.after is not None:
                left.plot(one.t[pick], one.after[pick], color=AFTER, lw=1.1, ls=(0, (5, 2)), label="after")
                right.plot(one.t[pick], (one.measured - one.after)[pick], color=AFTER, lw=0.9, label="after")
            left.set(title=f"{one.label}: measured and simulated", xlabel="time [s]", ylabel=_axis(one.label, one.unit))
            right.set(title="measured minus simulated", xlabel="time [s]", ylabel=f"error [{one.unit}]")
            left.legend(loc="upper right", ncols=3)
            right.legend(loc="upper right", ncols=2)
    return svg[0]


def _residual(views: Sequence[ResidualView]) -> str:
    """Draw the residual against each axis: samples, binned mean with its band, fitted effect on top."""
    columns = min(4, max(2, len({view.axis for view in views})))
    rows = -(-len(views) // columns)
    with drawing("residual", 10.5, 2.9 * rows) as (figure, svg):
        axes = figure.subplots(rows, columns, squeeze=False)
        for axis in axes.flat[len(views) :]:
            axis.remove()
        for axis, view in zip(axes.flat, views, strict=False):
            _one_view(axis, view)
        lines = {
            name: line for axis in figure.axes for line, name in zip(*axis.get_legend_handles_labels(), strict=True)
        }
        axes.flat[0].legend(lines.values(), lines.keys(), loc="best", fontsize=7.5)
    return svg[0]


def _caption(views: Sequence[ResidualView]) -> str:
    """Say what the panels of the residual show."""
    text = "What the nominal part leaves over against each axis: samples, binned mean with the 10–90 % band"  # noqa: RUF001
    if any(view.fitted is not None for view in views):
        return f"{text}, the fitted effect on top, and what is left after it."
    if any(view.after is not None for view in views):
        return f"{text}, and what is left with the effect."
    return f"{text}."


def _one_view(axis: Axes, view: ResidualView) -> None:
    """Draw one residual panel."""
    pick = _thin(view.x.size, 4000)
    dense = pick.size > 500
    axis.scatter(
        view.x[pick], view.before[pick], s=2.5 if dense else 9, color=DATA, alpha=0.25 if dense else 0.6, lw=0,
        rasterized=True,
    )  # fmt: skip
    _binned(axis, view.x, view.before, BEFORE, "before (mean, 10-90 %)")
    if view.after is not None:
        _binned(axis, view.x, view.after, AFTER, "after")
    if view.fitted is not None:
        _fitted(axis, view.x, view.fitted)
    shown = view.before if view.after is None else np.concatenate([view.before, view.after])
    low, high = np.quantile(shown, [0.005, 0.995])
    if view.deviation > 0:
        axis.axhspan(-2 * view.deviation, 2 * view.deviation, color=GREY, alpha=0.18, lw=0, label="±2 sd of one value")
        low, high = min(low, -2 * view.deviation), max(high, 2 * view.deviation)
    margin = 0.25 * max(high - low, 1e-300)
    axis.set_ylim(low - margin, high + margin)
    axis.set(
        title=f"against {view.axis}",
        xlabel=_axis(view.axis, view.unit),
        ylabel=f"{view.port} [{view.residual_unit}]"
        if view.deviation > 0
        else f"residual of {view.port} [{view.residual_unit}]",
    )


def _binned(axis: Axes, x: FloatArray, y: FloatArray, colour: str, label: str) -> None:
    """Draw binned mean and 10-90 % band of ``y`` over ``x``."""
    edges = np.unique(np.quantile(x, np.linspace(0, 1, 1 + min(24, max(4, x.size // 8)))))  # few samples, few bins
    if edges.size < 3:
        return
    which = np.clip(np.digitize(x, edges) - 1, 0, edges.size - 2)
    centre, mean, low, high = [], [], [], []
    for k in range(edges.size - 1):
        inside = which == k
        if inside.sum() >= 5:
            centre.append(float(np.median(x[inside])))
            mean.append(float(y[inside].mean()))
            a, b = np.quantile(y[inside], [0.1, 0.9])
            low.append(float(a))
            high.append(float(b))
    axis.fill_between(centre, low, high, color=colour, alpha=0.14, lw=0)
    axis.plot(centre, mean, color=colour, lw=1.5, marker="o", ms=2.4, label=label)


def _fitted(axis: Axes, x: FloatArray, force: FloatArray) -> None:
    """Draw the fitted effect: its mean over bins of the axis."""
    edges = np.unique(np.quantile(x, np.linspace(0, 1, min(60, max(6, x.size // 5)))))
    if edges.size < 3:
        return
    which = np.clip(np.digitize(x, edges) - 1, 0, edges.size - 2)
    count = np.bincount(which, minlength=edges.size - 1)
    good = count >= 3
    mean = np.bincount(which, force, minlength=edges.size - 1)[good] / count[good]
    centre = np.bincount(which, x, minlength=edges.size - 1)[good] / count[good]
    axis.plot(centre, mean, color=INK, lw=1.8, ls=(0, (2, 1.2)), label="fitted effect")


def _tests(pictures: Pictures) -> str:
    """Draw autocorrelation, input cross-correlation and CUSUM of squares, before and after, with 99 % bands."""
    series = [(pictures.before, BEFORE, "before"), (pictures.after, AFTER, "after")]
    with drawing("tests", 10.5, 2.9) as (figure, svg):
        panels = figure.subplots(1, 3 if pictures.u is not None else 2)
        for r, colour, label in series:
            if r is None:
                continue
            lags = min(60, r.size // 4)
            rho = autocorrelation(r, lags)
            panels[0].plot(np.arange(1, rho.size), rho[1:], color=colour, marker="o", ms=2.2, lw=1, label=label)
            path, _, _ = cusum_of_squares(r)
            pick = _thin(path.size, 1500)
            panels[-1].plot(pick * pictures.sample_time, path[pick], color=colour, label=label)
            if pictures.u is not None:
                cross = cross_correlation(pictures.u, r, lags)
                panels[1].plot(np.arange(-lags, lags + 1), cross, color=colour, lw=1, label=label)
        n = pictures.before.size if pictures.before is not None else 1
        for panel in panels:
            panel.axhspan(-correlation_band(n), correlation_band(n), color=GREY, alpha=0.22, lw=0, label="99 % band")
            panel.axhline(0, color=GREY, lw=0.7)
        panels[0].set(title=f"autocorrelation of the residual of {pictures.output_name}", xlabel="lag [samples]")
        panels[-1].set(title="CUSUM of squares", xlabel="time [s]")
        if pictures.u is not None:
            panels[1].set(title=f"cross-correlation with {pictures.input_name}", xlabel="lag [samples]")
        panels[0].legend(loc="best")
    return svg[0]


def _isolability(names: Sequence[str], cosines: FloatArray) -> str:
    """Draw the matrix of cosines."""
    n = len(names)
    size = min(10.5, 2.6 + 0.3 * n)
    with drawing("isolability", size, size * 0.86) as (figure, svg):
        axis = figure.subplots()
        image = axis.imshow(np.abs(cosines), vmin=0, vmax=1, cmap="Blues", interpolation="nearest")
        axis.set_xticks(range(n), names, rotation=60, ha="right", rotation_mode="anchor", fontsize=7.5)
        axis.set_yticks(range(n), names, fontsize=7.5)
        axis.grid(False)
        for i in range(n):
            for j in range(n):
                if i != j and abs(cosines[i, j]) >= 0.9:
                    text = f"{abs(cosines[i, j]):.2f}".lstrip("0")
                    axis.text(j, i, text, ha="center", va="center", color="white", fontsize=6.2)
        figure.colorbar(image, ax=axis, shrink=0.75, label="|cosine| (1: cannot be told apart)")
    return svg[0]


def _surrogates(null: FloatArray, observed: Mapping[str, float]) -> str:
    """Draw the null distribution and where the leading effects stand."""
    leaders = sorted(observed.items(), key=lambda item: -item[1])[:5]
    with drawing("surrogates", 5.4, 3.0) as (figure, svg):
        axis = figure.subplots()
        floor = max(float(null[null > 0].min(initial=1e-6)), 1e-9)
        top = max([float(null.max()), *(value for _, value in leaders)])
        edges = np.geomspace(floor, max(top, floor * 1.01) * 1.3, 50)
        axis.hist(np.maximum(null, floor), bins=edges.tolist(), color=DATA, label=f"{null.size} surrogates")
        axis.axvline(float(np.quantile(null, 0.99)), color=INK, lw=1, ls=":", label="99 % of surrogates")
        for rank, (name, value) in enumerate(leaders):
            axis.axvline(max(value, floor), color=BEFORE if rank == 0 else GREY, lw=1.6 if rank == 0 else 0.8)
            axis.annotate(
                name,
                (max(value, floor), 0.97 - 0.1 * rank),
                xycoords=("data", "axes fraction"),
                ha="right",
                va="top",
                fontsize=7.5,
                color=BEFORE if rank == 0 else INK,
            )
        axis.set(xscale="log", xlabel="(R²/k)/(1 - R²), largest of the dictionary", ylabel="surrogates")
        axis.legend(loc="center right", fontsize=7.5)
    return svg[0]


def _coverage(panels: Sequence[tuple[str, str, FloatArray, FloatArray, FloatArray, FloatArray]]) -> str:
    """Draw where in (q, v) the estimation and the validation records went."""
    shown = panels[:3]
    with drawing("coverage", 10.5, 3.2) as (figure, svg):
        axes: Any = figure.subplots(1, max(len(shown), 2), squeeze=False)
        for spare in axes[0][len(shown) :]:
            spare.remove()
        for axis, (name, unit, q, v, qv, vv) in zip(axes[0], shown, strict=False):
            a, b = _thin(q.size, 3000), _thin(qv.size, 3000)
            axis.scatter(q[a], v[a], s=2, color=DATA, lw=0, alpha=0.5, rasterized=True, label="estimation")
            axis.scatter(qv[b], vv[b], s=2, color=AFTER, lw=0, alpha=0.4, rasterized=True, label="validation")
            axis.set(title=f"coverage of {name}", xlabel=_axis(name, unit), ylabel=_axis(f"{name}'", f"{unit}/s"))
            axis.legend(loc="upper right", markerscale=4, fontsize=7.5)
    return svg[0]


def _axis(name: str, unit: str) -> str:
    """Return an axis label."""
    return f"{name} [{unit}]" if unit not in ("", "1") else name


def _thin(n: int, most: int) -> FloatArray:
    """Return at most about ``most`` indices spread over ``n`` samples."""
    return np.unique(np.linspace(0, n - 1, min(n, most)).astype(int))
