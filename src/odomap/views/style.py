"""One look for all figures: colours everybody can tell apart, quiet axes, crisp output.

Colours are those of Okabe and Ito, which survive the common kinds of colour blindness; where two
things must not be confused they differ in shape too. A figure becomes a PNG for files, or an SVG
for a page: there every colour of the palette is replaced by a CSS variable, so that one drawing
follows the reader's light or dark mode.

Reference: M. Okabe, K. Ito, "Color Universal Design", 2008.
"""

import io
import re

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

__all__ = [
    "ERROR_COLOURS",
    "PALETTE",
    "STAGES",
    "css_colour",
    "dress",
    "figure_jpeg",
    "figure_png",
    "figure_svg",
    "new_figure",
]

PALETTE = {
    "ink": "#1f2530",
    "muted": "#667080",
    "grid": "#dde2e9",
    "paper": "#fefefd",
    "estimate": "#0072b2",
    "truth": "#8a8f98",
    "band": "#bcd9ec",
    "keyframe": "#e69f00",
    "lost": "#d55e00",
    "good": "#009e73",
    "loop": "#b3268c",
    "before": "#a9cfe6",
    "stage1": "#0173b3",
    "stage2": "#56b4e9",
    "stage3": "#019f74",
    "stage4": "#cc79a7",
    "stage5": "#e6a001",
    "stage6": "#d9cd3a",
    "stage7": "#9aa1ab",
}
"""Names are CSS variables of the report; all values differ, so that each finds its variable."""

STAGES = tuple(PALETTE[f"stage{k}"] for k in range(1, 8))

ERROR_COLOURS = LinearSegmentedColormap.from_list(
    "odomap_error", ["#2f6fd6", "#6f62d4", "#ab50bb", "#db4f86", "#ee5440"]
)
"""From little (blue) to much (red); no end vanishes on white or on black, none is a keyframe's."""

SVG_DPI = 72
PNG_DPI = 144


def new_figure(width: float = 9.6, height: float = 3.2, right: float = 0.12) -> Figure:
    """Make an empty figure on paper colour with fixed margins, inches, without any global state.

    Fixed margins, since a layout that measures every text takes as long as the drawing itself.
    """
    figure = Figure(figsize=(width, height), facecolor=PALETTE["paper"])
    figure.subplots_adjust(
        left=0.62 / width,
        right=1.0 - right / width,
        bottom=0.45 / height,
        top=1.0 - 0.32 / height,
    )
    return figure


def css_colour(colour: str) -> str:
    """Return a colour of the palette as the CSS variable that follows light and dark."""
    return next((f"var(--{name})" for name, own in PALETTE.items() if own == colour), colour)


def plain(label: str) -> str:
    """Make any name safe as a label: no mathematics between dollars, nothing unprintable."""
    shown = "".join(c if c.isprintable() else " " for c in label).replace("$", r"\$")
    return shown.lstrip("_ ") or "unnamed"


def dress(ax: Axes, title: str = "", x: str = "", y: str = "") -> Axes:
    """Give axes the common look: title on the left, faint grid, two spines."""
    ax.set_facecolor("none")
    if title:
        ax.set_title(title, loc="left", fontsize=10, fontweight="bold", color=PALETTE["ink"])
    ax.set_xlabel(x, fontsize=9, color=PALETTE["muted"])
    ax.set_ylabel(y, fontsize=9, color=PALETTE["muted"])
    ax.tick_params(labelsize=8, colors=PALETTE["muted"], length=3, width=0.8)
    ax.grid(True, color=PALETTE["grid"], linewidth=0.7)
    ax.set_axisbelow(True)
    for name, spine in ax.spines.items():
        spine.set_visible(name in ("left", "bottom"))
        spine.set_color(PALETTE["muted"])
        spine.set_linewidth(0.8)
    return ax


def legend(ax: Axes, **options: object) -> None:
    """Add a quiet legend above the axes, to the right, where it hides nothing."""
    settings: dict[str, object] = {
        "loc": "lower right",
        "bbox_to_anchor": (1.0, 1.0),
        "ncols": 8,
        "frameon": False,
        "fontsize": 8,
        "labelcolor": PALETTE["ink"],
        "handlelength": 1.4,
        "columnspacing": 1.2,
        "borderaxespad": 0.2,
    }
    drawn = ax.legend(**{**settings, **options})
    for handle in drawn.legend_handles:
        if isinstance(handle, Line2D):
            handle.set(alpha=1.0, linewidth=max(handle.get_linewidth(), 1.0))


def figure_png(figure: Figure, dpi: float = PNG_DPI) -> bytes:
    """Render a figure as PNG; the same figure gives the same bytes."""
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=dpi, metadata={"Software": None})
    return out.getvalue()


def figure_jpeg(figure: Figure, quality: int = 82) -> bytes:
    """Render a figure that is mostly photograph as JPEG, at its own resolution."""
    out = io.BytesIO()
    figure.savefig(out, format="jpeg", dpi="figure", pil_kwargs={"quality": quality})
    return out.getvalue()


def figure_svg(figure: Figure, label: str) -> str:
    """Render a figure as SVG to stand inside a page, its colours as CSS variables.

    Args:
        figure: what to draw.
        label: what a person sees who cannot see it; plain text.

    Returns:
        One `<svg>` element, without any reference outside.
    """
    out = io.StringIO()
    # Fixed salt: ids, and so bytes, are the same in every run.
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": label, "path.simplify": True}):
        figure.savefig(out, format="svg", dpi=SVG_DPI, metadata={"Date": None}, transparent=True)
    return _for_page(out.getvalue(), label)


def _for_page(svg: str, label: str) -> str:
    import html

    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'\sxmlns(:\w+)?="[^"]*"', "", svg)
    svg = svg.replace("xlink:href", "href")
    svg = re.sub(r"<!--.*?-->\s*", "", svg, flags=re.DOTALL)
    head, body = svg.split(">", 1)
    box = re.search(r'viewBox="[^"]*"', head)
    title = html.escape(label)
    svg = f'<svg {box.group() if box else ""} role="img" aria-label="{title}">{body}'
    for name, colour in PALETTE.items():
        svg = svg.replace(colour, f"var(--{name})")
    return re.sub(r"\n\s*", "\n", svg)
