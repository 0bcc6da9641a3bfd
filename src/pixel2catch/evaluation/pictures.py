"""Figures as files."""

import io

from matplotlib.figure import Figure

DPI = 160
"""Pixels of an inch."""


def png(figure: Figure) -> bytes:
    """The figure as a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    return buffer.getvalue()
