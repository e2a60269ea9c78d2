"""The page that a figure is drawn on: no title or legend is wider than the page, and none lies over another.

`closedloop.figures.style` makes pages; this module is apart because it imports matplotlib.
"""

from typing import Any, cast

import matplotlib as mpl
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.legend import Legend
from matplotlib.text import Text

# Type 3 fonts, matplotlib's default, are refused by journals; text of Type 42 (TrueType) can be edited as well.
TRUETYPE = {"pdf.fonttype": 42, "ps.fonttype": 42}
# Between a title and the legend beside it, or the edge of the page, as a share of the font's size.
GAP = 1.0


class Page(Figure):
    """A figure that is laid out and saved with matplotlib's settings at the time at which it was made.

    `settings`: the names of these settings.
    """

    def __init__(self, settings: Any, **more: Any) -> None:
        self.settings = {name: mpl.rcParams[name] for name in settings} | TRUETYPE
        self.beside: dict[Axes, tuple[list[Artist], list[str]]] = {}
        self.whole: dict[Text, tuple[str, str]] = {}  # titles in several lines: what they were, and what they are
        super().__init__(**more, layout=PageLayout())

    def __repr__(self) -> str:
        """Return what a notebook shows of any figure: its size in pixels, and how many panels it has."""
        width, height = self.bbox.size
        return f"<Figure size {width:g}x{height:g} with {len(self.axes)} Axes>"

    def savefig(self, fname: Any, **more: Any) -> None:
        """Save the figure as `matplotlib.figure.Figure.savefig` does, with its own settings."""
        with mpl.rc_context(self.settings):
            super().savefig(fname, **more)

    def legend_beside(self, axes: Axes, handles: list[Artist], labels: list[str]) -> None:
        """Give a panel a legend beside its title, or below the title where both have no room in a line."""
        if handles:
            self.beside[axes] = handles, labels
            self._put(axes, len(handles))  # there is one at once, and `fit` puts it in its place

    def _put(self, axes: Axes, ncols: int, *, left: bool = False) -> Legend:
        handles, labels = self.beside[axes]
        return axes.legend(
            handles, labels, loc="lower left" if left else "lower right", bbox_to_anchor=(0.0 if left else 1.0, 1.0),
            ncols=ncols, fontsize="small", borderaxespad=0.0, columnspacing=1.2,
        )  # fmt: skip

    def legend_outside(self, where: str, handles: list[Artist], labels: list[str], most: int, title: str = "") -> None:
        """Give the page a legend above or below all panels, of up to `most` columns, or as many as it has room for."""
        room, place = float(self.bbox.width), cast(Any, f"outside {where}")

        def put(ncols: int) -> Legend:
            return self.legend(
                handles, labels, loc=place, ncols=ncols, fontsize="small", columnspacing=1.5,
                title=title, title_fontsize="small",
            )  # fmt: skip

        widest(put, min(most, len(handles)), room)

    def fit(self) -> None:
        """Break the titles, and move the legends beside them, that have no room where the panels are now."""
        gap = GAP * mpl.rcParams["font.size"] * self.dpi / 72.0
        for axes in self.axes:
            title, pad = left_title(axes), 0.0
            panel = axes.get_window_extent()
            left = float(panel.x0)
            if axes in self.beside:
                count = len(self.beside[axes][0])
                legend = self._put(axes, count)
                taken = width_of(title) + gap if title.get_text() else 0.0
                if taken > float(legend.get_window_extent().x0) - left:  # a line for each
                    legend = widest(lambda ncols, axes=axes: self._put(axes, ncols, left=True), count, panel.width)
                    pad = float(legend.get_window_extent().height) * 72.0 / self.dpi if taken else 0.0
            whole = title.get_text()
            # A title ends at the panel beside it, or at the edge of the page.
            others = [each.get_window_extent() for each in self.axes if each.get_label() != "<colorbar>"]
            beside = [
                other.x0 for other in others if other.x0 > panel.x1 and other.y0 < panel.y1 and other.y1 > panel.y0
            ]
            title.set_text(broken(title, float(min(beside, default=self.bbox.x1)) - gap - left))
            if title.get_text() != whole:
                self.whole[title] = whole, title.get_text()
            title.set_in_layout(True)
            axes._set_title_offset_trans(mpl.rcParams["axes.titlepad"] + pad)  # type: ignore[attr-defined]


class PageLayout(ConstrainedLayoutEngine):
    """matplotlib's constrained layout, done twice: the first says how much room titles and their legends have."""

    def execute(self, fig: Any) -> None:
        """Lay a page out."""
        with mpl.rc_context(fig.settings):
            # The page may have another size since `fit`: what it did is undone.
            for title, (whole, shown) in fig.whole.items():
                if title.get_text() == shown:
                    title.set_text(whole)
            fig.whole.clear()
            for axes in fig.axes:
                left_title(axes).set_in_layout(False)
                if axes in fig.beside and (legend := axes.get_legend()):
                    legend.set_in_layout(False)
            super().execute(fig)
            fig.fit()
            super().execute(fig)


def left_title(axes: Axes) -> Text:
    """Return the title of a panel, whose own `set_title` would give it the font of the settings."""
    found: Text = axes._left_title  # type: ignore[attr-defined]
    return found


def widest(put: Any, ncols: int, room: float) -> Any:
    """Return the legend with the most columns, up to `ncols`, that is no wider than `room`, in pixels."""
    legend = put(ncols)
    while ncols > 1 and float(legend.get_window_extent().width) > room:
        legend.remove()
        ncols -= 1
        legend = put(ncols)
    return legend


def width_of(text: Text, content: str | None = None) -> float:
    """Return how wide a text is, or would be with another content, in pixels."""
    own = text.get_text()
    text.set_text(own if content is None else content)
    width = float(text.get_window_extent().width)
    text.set_text(own)
    return width


def broken(text: Text, room: float) -> str:
    """Return the content of a text, in as many lines as it needs to be no wider than `room`, in pixels."""
    lines = []
    for paragraph in text.get_text().split("\n"):
        line, *words = paragraph.split(" ")
        for word in words:
            if width_of(text, f"{line} {word}") > room:
                lines.append(line)
                line = word
            else:
                line = f"{line} {word}"
        lines.append(line)
    return "\n".join(lines)
