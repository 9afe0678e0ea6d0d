#!/usr/bin/env python3
"""Draw the diagrams of the documentation: python tools/docs_images.py writes docs/images/*.svg.

The frames of the Raptor are drawn from its geometry file; the other diagrams are boxes and arrows. All are plain SVG
without scripts, fonts or links.
"""

from __future__ import annotations

import html
import math
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
IMAGES = ROOT / "docs" / "images"

INK, LINE, PAPER = "#22303c", "#607d8b", "#ffffff"
BLUE, GREEN, RED, AMBER, GRAY = "#1e6fb8", "#2e8b57", "#c0392b", "#d98200", "#9aa5ae"
FILL = {LINE: "#eef2f5", BLUE: "#e3eefa", GREEN: "#e2f3e9", AMBER: "#fcf0db"}


def element(name: str, content: str = "", /, **attributes: str | float) -> str:
    """Return an XML element; `_` in an attribute's name becomes `-`."""
    words = [name]
    for key, each in attributes.items():
        value = html.escape(each) if isinstance(each, str) else f"{each:.1f}".removesuffix(".0")
        words.append(f'{key.replace("_", "-")}="{value}"')
    return f"<{' '.join(words)}>{content}</{name}>" if content else f"<{' '.join(words)}/>"


def format_points(points: Iterable[tuple[float, float]]) -> str:
    """Return points as an attribute of a polyline or a polygon has them."""
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in points)


def render_text(x: float, y: float, words: str, **attributes: str | float) -> str:
    return element("text", html.escape(words), x=x, y=y, **attributes)


class Drawing:
    """Elements of an SVG image."""

    def __init__(self, width: float, height: float, title: str):
        self.width, self.height, self.title = width, height, title
        self.parts: list[str] = []

    def text(self, x: float, y: float, words: str, size: float = 13, color: str = INK, anchor: str = "middle") -> None:
        """Write words at a baseline; larger ones than 12 are bold."""
        bold = {"font_weight": "600"} if size > 12 else {}
        style = {"fill": color, "text_anchor": anchor} | bold
        self.parts.append(render_text(x, y, words, font_size=size, **style))

    def box(self, x: float, y: float, width: float, height: float, words: str, color: str = LINE) -> None:
        """Draw a box with lines of words; the first is its title."""
        style = {"fill": FILL[color], "stroke": color}
        self.parts.append(element("rect", x=x, y=y, width=width, height=height, rx=6, **style))
        lines = words.splitlines()
        top = y + height / 2 - (len(lines) - 1) * 8 + 4.5
        for number, line in enumerate(lines):
            self.text(x + width / 2, top + 16 * number, line, 11 if number else 13)

    def line(self, *points: tuple[float, float], color: str = LINE, width: float = 1.6, dash: str = "none") -> None:
        style = {"points": format_points(points), "fill": "none", "stroke": color, "stroke_dasharray": dash}
        self.parts.append(element("polyline", **style, stroke_width=width))

    def arrow(self, *points: tuple[float, float], words: str = "", color: str = LINE) -> None:
        """Draw an arrow through points with words above the middle of its ends."""
        (x1, y1), (x2, y2) = points[-2:]
        length = math.hypot(x2 - x1, y2 - y1)
        ux, uy = (x2 - x1) / length, (y2 - y1) / length
        bx, by = x2 - 9 * ux, y2 - 9 * uy
        self.line(*points[:-1], (bx, by), color=color)
        self.polygon(((x2, y2), (bx - 4 * uy, by + 4 * ux), (bx + 4 * uy, by - 4 * ux)), color)
        if words:
            self.text((points[0][0] + x2) / 2, (points[0][1] + y2) / 2 - 6, words, 11)

    def polygon(self, points: Iterable[tuple[float, float]], fill: str, color: str = "none") -> None:
        style = {"points": format_points(points), "fill": fill, "stroke": color}
        self.parts.append(element("polygon", **style, stroke_width=1.2))

    def dot(self, x: float, y: float, radius: float, fill: str, color: str = "none") -> None:
        self.parts.append(element("circle", cx=x, cy=y, r=radius, fill=fill, stroke=color))

    def svg(self) -> str:
        """Return the image as text."""
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {self.width:g} {self.height:g}" '
            f'width="{self.width:g}" height="{self.height:g}" font-family="Helvetica, Arial, sans-serif" role="img">\n'
            f"<title>{html.escape(self.title)}</title>\n"
            f'<rect width="{self.width:g}" height="{self.height:g}" rx="8" fill="{PAPER}"/>\n'
            + "\n".join(self.parts)
            + "\n</svg>\n"
        )


def data_flow() -> Drawing:
    """Draw devices, drivers, bus, service and clients."""
    d = Drawing(860, 330, "Data flow: devices, drivers, LCM bus, service, clients")
    for row, (device, driver, channel) in enumerate(
        (
            ("GPS receiver", "driver gps", "GPS"),
            ("IMU", "driver imu", "IMU"),
            ("wheels (CAN)", "driver wheels", "WHEELS"),
            ("joint axis", "driver axis", "JOINTS"),
        )
    ):
        y = 24 + 54 * row
        d.box(16, y, 106, 38, device)
        d.box(166, y, 106, 38, driver, GREEN)
        d.arrow((122, y + 19), (166, y + 19))
        d.arrow((272, y + 19), (330, y + 19))
        d.text(301, y + 12, channel, 10)
    d.box(330, 18, 60, 290, "LCM\nUDP\nmulti-\ncast", AMBER)
    d.box(146, 262, 126, 38, "your program\nany sample")
    d.arrow((272, 281), (330, 281))
    d.box(470, 24, 170, 200, "", BLUE)
    d.text(555, 46, "modelserver run")
    d.box(488, 58, 134, 44, "localization\nfilter or raw mode")
    d.box(488, 112, 134, 44, "geometry\nframes, joints")
    d.box(488, 166, 134, 44, "history\nposes, joint readings")
    d.arrow((390, 80), (470, 80), words="samples")
    d.arrow((470, 124), (390, 124), words="POSE, health")
    d.arrow((390, 170), (470, 170), words="requests")
    d.arrow((470, 206), (390, 206), words="replies")
    d.box(488, 256, 134, 44, "journal, state\non disk")
    d.arrow((555, 224), (555, 256))
    d.line((360, 308), (360, 316), (670, 316), (670, 60), color=AMBER)
    for y, words in (
        (60, "Platform\na round trip per query"),
        (148, "PlatformMirror\nanswers locally"),
        (236, "modelserver query\nstatus, spy, replay"),
    ):
        d.box(696, y - 24, 152, 48, words)
        d.arrow((670, y), (696, y), color=AMBER)
    return d


def filter_flow() -> Drawing:
    """Draw the error-state filter: propagation, update, outputs."""
    d = Drawing(860, 330, "Error-state Kalman filter: data flow")
    d.box(16, 30, 120, 44, "IMU\nrates, specific force", GREEN)
    d.box(190, 22, 190, 60, "propagate\nnominal state: strapdown\nP = F P F' + Q, 50 ms at most", BLUE)
    d.box(16, 130, 120, 44, "fixes, wheels,\nfurther sources", GREEN)
    d.box(190, 122, 190, 60, "measurement buffer\nordered by instant,\ndelayed ones inserted")
    words = "innovation and gate\ny = z - h(x),  S = H P H' + R\ny' S^-1 y < chi-square quantile"
    d.box(440, 122, 180, 60, words, BLUE)
    d.box(440, 232, 180, 60, "update\nJoseph form, inject error,\nreset Jacobian", BLUE)
    d.box(680, 122, 164, 60, "decision ledger\nused, rejected, monitored\nLOCALIZATION_DECISIONS", AMBER)
    d.box(680, 22, 164, 60, "rejected fixes\nagree with odometry?\nre-initialize position", AMBER)
    d.box(680, 232, 164, 60, "estimate\nPOSE, POSE_ODOM, twist,\nprotection level, validity", GREEN)
    d.box(16, 232, 120, 60, "logic\nleveling, stationary,\nheading alignment")
    d.arrow((136, 52), (190, 52))
    d.arrow((136, 152), (190, 152))
    d.arrow((380, 152), (440, 152))
    d.arrow((380, 52), (530, 52), (530, 122))
    d.arrow((530, 182), (530, 232))
    d.arrow((440, 262), (160, 262), (160, 102), (285, 102), (285, 82))
    d.arrow((620, 152), (680, 152))
    d.arrow((762, 122), (762, 82))
    d.arrow((620, 262), (680, 262))
    d.arrow((136, 262), (160, 262))
    d.text(455, 44, "state, covariance", 11)
    d.text(558, 212, "passed", 11)
    d.text(300, 254, "corrected state", 11)
    return d


def delayed_measurement() -> Drawing:
    """Draw the time line of a delayed measurement."""
    d = Drawing(860, 250, "Time line of a delayed measurement")

    def at(step: float) -> float:
        return 90.0 + 56.0 * step

    for y, words in ((70, "arrival"), (150, "instant")):
        d.text(80, y + 4, words, anchor="end")
        d.arrow((at(0), y), (at(13), y))
    for step in range(12):
        d.dot(at(step + 0.15), 70, 3.5, GREEN)
        d.dot(at(step), 150, 3.5, GREEN)
        d.line((at(step + 0.15), 70), (at(step), 150), color="#b8d8c4", width=1)
    d.dot(at(4), 150, 6, BLUE)
    d.dot(at(9.5), 70, 6, BLUE)
    d.line((at(9.5), 70), (at(4), 150), color=BLUE, width=1.8, dash="5 4")
    d.line((at(4), 190), (at(4), 200), (at(9.5), 200), (at(9.5), 190), color=AMBER)
    d.line((at(0.5), 28), (at(9.5), 28), width=1.2, dash="3 3")
    for step in (0.5, 9.5):
        d.line((at(step), 22), (at(step), 34), width=1.2)
    for step, y, words, color in (
        (12.6, 172, "time", INK),
        (9.5, 54, "fix arrives", BLUE),
        (4, 176, "fix was measured", BLUE),
        (1.2, 54, "IMU samples", GREEN),
        (6.75, 218, "stored states: insert the fix, process these again", AMBER),
        (5, 20, "horizon 1 s: what was measured before is rejected (late)", LINE),
    ):
        d.text(at(step), y, words, 12, color)
    return d


def raptor_frames() -> Drawing:
    """Draw the frames of the Raptor in side view, placed by its geometry file."""
    import modelserver as ms

    model = ms.load_model(ROOT / "config" / "raptor" / "geometry.yaml")
    d = Drawing(860, 640, "Frames of the Raptor, side view")
    scale, x0, z0 = 225.0, 240.0, 582.0

    def place(x: float, z: float) -> tuple[float, float]:
        return x0 + scale * x, z0 - scale * z

    outline = (
        (-0.45, 0.4),
        (2.05, 0.4),
        (2.05, 0.95),
        (1.6, 1.1),
        (1.45, 1.84),
        (0.75, 1.87),
        (0.62, 1.2),
        (-0.45, 1.2),
    )
    d.polygon((place(*each) for each in outline), "#f3f5f7", GRAY)
    for x in (0.0, 1.5):
        d.dot(*place(x, 0.3), 0.3 * scale, "#e6eaee", GRAY)
    d.line((20, z0), (840, z0), color=GRAY, width=1)
    reference = "Raptor:RearAxleCenter"
    labels = {
        reference: (10, 22, "start", "rolling frame: GPS course is its heading"),
        "Raptor:CG": (-70, -76, "start", "base frame: POSE describes it"),
        "Raptor:FrontLeftWheelContact": (10, 22, "start", ""),
        "BackSICKLaser:Scan": (-8, -62, "middle", ""),
        "GPSAntenna:PhaseCenter": (-20, -12, "end", ""),
        "Microstrain:Sensor": (-20, 28, "end", "IMU, z down"),
        "FLEA:Lens": (22, 42, "start", ""),
        "FrontSICKLaser:Scan": (60, 14, "start", "moves with a joint"),
        "Digiclops:ImagePlane": (20, -42, "start", ""),
    }
    for name, (dx, dy, anchor, words) in labels.items():
        T = model.get_transformation(name, reference)
        px, py = place(float(T.position[0]), float(T.position[2]))
        rotation = T.matrix[:3, :3]
        for axis, color, label in ((0, RED, "x"), (2, BLUE, "z")):
            ex, ez = rotation[0, axis], rotation[2, axis]
            d.arrow((px, py), (px + 42 * ex, py - 42 * ez), color=color)
            d.text(px + 50 * ex, py - 50 * ez + 4, label, 10, color)
        d.dot(px, py, 3, INK)
        d.text(px + dx, py + dy, name, 12.5, anchor=anchor)
        if words:
            d.text(px + dx, py + dy + 14, words, 11, LINE, anchor)
    return d


DRAWINGS: dict[str, Callable[[], Drawing]] = {
    "data-flow": data_flow,
    "filter": filter_flow,
    "delayed-measurement": delayed_measurement,
    "raptor-frames": raptor_frames,
}


def main() -> int:
    """Write the images that are named, or all."""
    for name in sys.argv[1:] or DRAWINGS:
        (IMAGES / f"{name}.svg").write_text(DRAWINGS[name]().svg(), encoding="utf-8")
        print(f"docs/images/{name}.svg")
    return 0


if __name__ == "__main__":
    sys.exit(main())
