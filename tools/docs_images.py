#!/usr/bin/env python3
"""Draw the diagrams of the documentation: python tools/docs_images.py writes docs/images/*.svg.

The frames of the Raptor are drawn from its geometry file, the drive from a simulation; the other diagrams are boxes and
arrows. All are plain SVG without scripts, fonts or links.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable, Sequence
from html import escape
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
IMAGES = ROOT / "docs" / "images"

INK, LINE, PAPER = "#22303c", "#607d8b", "#ffffff"
BLUE, GREEN, RED, AMBER, GRAY = "#1e6fb8", "#2e8b57", "#c0392b", "#d98200", "#9aa5ae"
FILL = {"": "#eef2f5", BLUE: "#e3eefa", GREEN: "#e2f3e9", AMBER: "#fcf0db", RED: "#fae4e1"}


class Drawing:
    """Elements of an SVG image."""

    def __init__(self, width: float, height: float, title: str):
        self.width, self.height, self.title = width, height, title
        self.parts: list[str] = []

    def text(
        self,
        x: float,
        y: float,
        words: str,
        size: float = 13,
        color: str = INK,
        anchor: str = "middle",
        weight: str = "",
    ) -> None:
        """Write words at a baseline."""
        bold = ' font-weight="600"' if weight else ""
        self.parts.append(
            f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size:g}" fill="{color}" text-anchor="{anchor}"{bold}>'
            f"{escape(words)}</text>"
        )

    def box(self, x: float, y: float, width: float, height: float, lines: Sequence[str], color: str = "") -> None:
        """Draw a box with a title line and further lines."""
        self.parts.append(
            f'<rect x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}" rx="6" fill="{FILL[color]}" '
            f'stroke="{color or LINE}" stroke-width="1.3"/>'
        )
        top = y + height / 2 - (len(lines) - 1) * 8 + 4.5
        for number, words in enumerate(lines):
            self.text(
                x + width / 2, top + 16 * number, words, 13 if number == 0 else 11, weight="1" if number == 0 else ""
            )

    def line(
        self, points: Iterable[tuple[float, float]], color: str = LINE, width: float = 1.6, dash: str = ""
    ) -> None:
        """Draw a polyline."""
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        dashed = f' stroke-dasharray="{dash}"' if dash else ""
        self.parts.append(f'<polyline points="{path}" fill="none" stroke="{color}" stroke-width="{width:g}"{dashed}/>')

    def arrow(
        self,
        x1: float,
        y1: float,
        x2: float,
        y2: float,
        words: str = "",
        color: str = LINE,
        above: float = 6,
        dash: str = "",
    ) -> None:
        """Draw an arrow with words at its middle."""
        length = math.hypot(x2 - x1, y2 - y1)
        ux, uy = (x2 - x1) / length, (y2 - y1) / length
        bx, by = x2 - 9 * ux, y2 - 9 * uy
        self.line([(x1, y1), (bx, by)], color, dash=dash)
        corners = ((x2, y2), (bx - 4 * uy, by + 4 * ux), (bx + 4 * uy, by - 4 * ux))
        self.polygon(corners, color)
        if words:
            self.text((x1 + x2) / 2, (y1 + y2) / 2 - above, words, 11)

    def polygon(self, points: Iterable[tuple[float, float]], fill: str, color: str = "none") -> None:
        """Draw a closed shape."""
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        self.parts.append(f'<polygon points="{path}" fill="{fill}" stroke="{color}" stroke-width="1.2"/>')

    def circle(self, x: float, y: float, radius: float, fill: str, color: str) -> None:
        """Draw a circle with an outline."""
        self.parts.append(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:.1f}" fill="{fill}" stroke="{color}" stroke-width="1.2"/>'
        )

    def dot(self, x: float, y: float, radius: float, color: str) -> None:
        """Draw a dot."""
        self.parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:g}" fill="{color}"/>')

    def svg(self) -> str:
        """Return the image as text."""
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {self.width:g} {self.height:g}" '
            f'width="{self.width:g}" height="{self.height:g}" font-family="Helvetica, Arial, sans-serif" role="img">\n'
            f"<title>{escape(self.title)}</title>\n"
            f'<rect width="{self.width:g}" height="{self.height:g}" rx="8" fill="{PAPER}"/>\n'
            + "\n".join(self.parts)
            + "\n</svg>\n"
        )


def data_flow() -> Drawing:
    """Draw devices, drivers, bus, service and clients."""
    d = Drawing(860, 330, "Data flow: devices, drivers, LCM bus, service, clients")
    for row, (device, driver) in enumerate(
        (
            ("GPS receiver", "driver gps"),
            ("IMU", "driver imu"),
            ("wheels (CAN)", "driver wheels"),
            ("joint axis", "driver axis"),
        )
    ):
        y = 24 + 54 * row
        d.box(16, y, 106, 38, [device])
        d.box(166, y, 106, 38, [driver], GREEN)
        d.arrow(122, y + 19, 166, y + 19)
        d.arrow(272, y + 19, 330, y + 19)
    for x, y, words in ((301, 36, "GPS"), (301, 90, "IMU"), (301, 144, "WHEELS"), (301, 198, "JOINTS")):
        d.text(x, y, words, 10)
    d.box(330, 18, 60, 290, ["LCM", "UDP", "multi-", "cast"], AMBER)
    d.box(146, 262, 126, 38, ["your program", "any sample"])
    d.arrow(272, 281, 330, 281)
    d.box(470, 24, 170, 200, ["modelserver run"], BLUE)
    d.parts.pop()
    d.text(555, 46, "modelserver run", 13, weight="1")
    d.box(488, 58, 134, 44, ["localization", "filter or raw mode"])
    d.box(488, 112, 134, 44, ["geometry", "frames, joints"])
    d.box(488, 166, 134, 44, ["history", "poses, joint readings"])
    d.arrow(390, 80, 470, 80, "samples")
    d.arrow(470, 124, 390, 124, "POSE, health", above=6)
    d.arrow(390, 170, 470, 170, "requests")
    d.arrow(470, 206, 390, 206, "replies")
    d.box(488, 256, 134, 44, ["journal, state", "on disk"])
    d.arrow(555, 224, 555, 256)
    for row, (name, about) in enumerate(
        (
            ("Platform", "a round trip per query"),
            ("PlatformMirror", "answers locally"),
            ("modelserver query", "status, spy, replay"),
        )
    ):
        y = 36 + 88 * row
        d.box(696, y, 152, 48, [name, about])
    d.line([(390, 316), (670, 316), (670, 60)], AMBER)
    for y in (60, 148, 236):
        d.arrow(670, y, 696, y, color=AMBER)
    d.line([(360, 308), (360, 316), (390, 316)], AMBER)
    return d


def filter_flow() -> Drawing:
    """Draw the error-state filter: propagation, update, outputs."""
    d = Drawing(860, 330, "Error-state Kalman filter: data flow")
    d.box(16, 30, 120, 44, ["IMU", "rates, specific force"], GREEN)
    d.box(190, 22, 190, 60, ["propagate", "nominal state: strapdown", "P = F P F' + Q, 50 ms at most"], BLUE)
    d.arrow(136, 52, 190, 52)
    d.box(16, 130, 120, 44, ["fixes, wheels,", "further sources"], GREEN)
    d.box(190, 122, 190, 60, ["measurement buffer", "ordered by instant,", "delayed ones inserted"])
    d.arrow(136, 152, 190, 152)
    d.box(
        440,
        122,
        180,
        60,
        ["innovation and gate", "y = z - h(x),  S = H P H' + R", "y' S^-1 y < chi-square quantile"],
        BLUE,
    )
    d.arrow(380, 152, 440, 152)
    d.line([(380, 52), (530, 52), (530, 114)])
    d.arrow(530, 100, 530, 122, "")
    d.text(455, 44, "state, covariance", 11)
    d.box(440, 232, 180, 60, ["update", "Joseph form, inject error,", "reset Jacobian"], BLUE)
    d.arrow(530, 182, 530, 232)
    d.text(540, 212, "passed", 11, anchor="start")
    d.line([(440, 262), (160, 262), (160, 102), (285, 102)])
    d.arrow(285, 102, 285, 82)
    d.text(300, 254, "corrected state", 11)
    d.box(680, 122, 164, 60, ["decision ledger", "used, rejected, monitored", "LOCALIZATION_DECISIONS"], AMBER)
    d.arrow(620, 152, 680, 152)
    d.box(680, 22, 164, 60, ["rejected fixes", "agree with odometry?", "re-initialize position"], AMBER)
    d.arrow(762, 122, 762, 82)
    d.box(680, 232, 164, 60, ["estimate", "POSE, POSE_ODOM, twist,", "protection level, validity"], GREEN)
    d.arrow(620, 262, 680, 262)
    d.box(16, 232, 120, 60, ["logic", "leveling, stationary,", "heading alignment"])
    d.arrow(136, 262, 160, 262)
    return d


def delayed_measurement() -> Drawing:
    """Draw the time line of a delayed measurement."""
    d = Drawing(860, 250, "Time line of a delayed measurement")
    start, scale = 90.0, 56.0

    def at(step: float) -> float:
        return start + scale * step

    d.text(80, 74, "arrival", 12, anchor="end", weight="1")
    d.text(80, 154, "instant", 12, anchor="end", weight="1")
    for y in (70, 150):
        d.arrow(at(0), y, at(13), y)
    d.text(at(12.6), 172, "time", 11)
    for step in range(12):
        d.dot(at(step + 0.15), 70, 3.5, GREEN)
        d.dot(at(step), 150, 3.5, GREEN)
        d.line([(at(step + 0.15), 70), (at(step), 150)], "#b8d8c4", 1)
    d.dot(at(4), 150, 6, BLUE)
    d.dot(at(9.5), 70, 6, BLUE)
    d.line([(at(9.5), 70), (at(4), 150)], BLUE, 1.8, "5 4")
    d.text(at(9.5), 54, "fix arrives", 12, BLUE)
    d.text(at(4), 176, "fix was measured", 12, BLUE)
    d.text(at(1.2), 54, "IMU samples", 12, GREEN)
    d.line([(at(4), 190), (at(4), 200), (at(9.5), 200), (at(9.5), 190)], AMBER)
    d.text(at(6.75), 218, "stored states: insert the fix, process these again", 12, AMBER)
    d.line([(at(0.5), 28), (at(9.5), 28)], LINE, 1.2, "3 3")
    d.line([(at(0.5), 22), (at(0.5), 34)], LINE, 1.2)
    d.line([(at(9.5), 22), (at(9.5), 34)], LINE, 1.2)
    d.text(at(5), 20, "horizon 1 s: what was measured before is rejected (late)", 11, LINE)
    return d


def raptor_frames() -> Drawing:
    """Draw the frames of the Raptor in side view, placed by its geometry file."""
    import modelserver as ms

    model = ms.load_model(ROOT / "config" / "raptor" / "geometry.yaml")
    d = Drawing(860, 640, "Frames of the Raptor, side view")
    scale, x0, z0 = 225.0, 240.0, 582.0

    def place(x: float, z: float) -> tuple[float, float]:
        return x0 + scale * x, z0 - scale * z

    outline = [
        (-0.45, 0.4),
        (2.05, 0.4),
        (2.05, 0.95),
        (1.6, 1.1),
        (1.45, 1.84),
        (0.75, 1.87),
        (0.62, 1.2),
        (-0.45, 1.2),
    ]
    d.polygon([place(*each) for each in outline], "#f3f5f7", GRAY)
    for x in (0.0, 1.5):
        d.circle(*place(x, 0.3), 0.3 * scale, "#e6eaee", GRAY)
    d.line([(20, z0), (840, z0)], GRAY, 1)
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
            d.arrow(px, py, px + 42 * ex, py - 42 * ez, color=color)
            d.text(px + 50 * ex, py - 50 * ez + 4, label, 10, color)
        d.dot(px, py, 3, INK)
        d.text(px + dx, py + dy, name, 12, anchor=anchor, weight="1")
        if words:
            d.text(px + dx, py + dy + 14, words, 11, LINE, anchor)
    return d


OUTAGE = (40.0, 70.0)
"""Seconds of the drawn drive without GPS."""


def drive() -> Drawing:
    """Draw a simulated drive of the Raptor with GPS and IMU: track, fixes, estimate; error and protection level."""
    from modelserver.config.vehicle_file import load_config
    from modelserver.earth.geodesy import origin_at
    from modelserver.estimation.filter.localizer import FilterLocalizer
    from modelserver.estimation.filter.setup import Setup
    from modelserver.messages import GpsSample
    from modelserver.server.vehicle import load_vehicle
    from modelserver.simulation import GpsModel, ImuModel, Simulation, Timing, Trajectory, figure_eight

    vehicle = load_vehicle(load_config(ROOT / "config" / "raptor" / "vehicle.yaml"))
    config = vehicle.config
    simulation = Simulation(
        vehicle.model,
        config.base_frame,
        Trajectory(figure_eight(speed=3.0, radius=15.0, stationary=4.0, laps=2)),
        origin_at(50.27, -111.18, 700.0),
        gps_frame=config.sensors.gps.frame,
        imu_frame=config.sensors.imu.frame,
        rolling_frame=config.rolling_frame,
        gps_model=GpsModel(outages=(OUTAGE,)),
        imu_model=ImuModel(Timing(50.0)),
        seed=3,
    )
    X_rolling_base = vehicle.model.get_transformation(config.base_frame, config.rolling_frame).pose
    localizer = FilterLocalizer.start(Setup(vehicle.rig), origin_at(50.27, -111.18, 700.0))
    fixes, truth, rows = [], [], []
    start = None
    for sample in simulation.events(96.0):
        localizer, _ = localizer.process(sample)
        start = start or sample.header.utime
        if isinstance(sample, GpsSample) and math.isfinite(sample.latitude_deg) and sample.header.seq % 4 == 0:
            # meters per degree at 50.27 degrees north; the antenna is 0.45 m to the left of the base frame
            fixes.append(((sample.longitude_deg + 111.18) * 71_293.0, (sample.latitude_deg - 50.27) * 111_234.0))
        if sample.header.seq % 10 or isinstance(sample, GpsSample):
            continue
        estimate = localizer.estimate(localizer.utime)
        true = simulation.truth(localizer.utime).enu.xyz
        truth.append(true)
        if estimate.enu is not None and not estimate.invalid:
            seconds = (localizer.utime - start) * 1e-6
            found = (estimate.enu @ X_rolling_base).xyz
            rows.append((seconds, found, math.dist(found[:2], true[:2]), estimate.horizontal_protection_level))

    d = Drawing(860, 380, "A simulated drive with 30 s without GPS")

    def on_map(point: Sequence[float]) -> tuple[float, float]:
        return 70 + 4.9 * (point[0] + 32), 194 - 4.9 * point[1]

    d.text(225, 24, "Track, 3 m/s", 13, weight="1")
    d.line([on_map(each) for each in truth], "#cfd8dc", 7)
    for fix in fixes:
        d.dot(*on_map(fix), 2.6, GREEN)
    for color, inside in ((BLUE, False), (AMBER, True)):
        part: list[tuple[float, float]] = []
        for seconds, found, _, _ in [*rows, (math.inf, (0, 0, 0), 0, 0)]:
            if (OUTAGE[0] <= seconds <= OUTAGE[1]) == inside and seconds < math.inf:
                part.append(on_map(found))
            elif part:
                d.line(part, color, 2)
                part = []
    for x, color, words in (
        (50, "#b0bec5", "truth"),
        (110, GREEN, "fixes"),
        (165, BLUE, "estimate"),
        (243, AMBER, "without GPS"),
    ):
        d.dot(x, 366, 4, color)
        d.text(x + 9, 370, words, 11, anchor="start")

    def on_chart(seconds: float, meters: float) -> tuple[float, float]:
        return 490 + 3.6 * seconds, 330 - 36 * meters

    d.text(660, 24, "Horizontal error and protection level", 13, weight="1")
    (x1, _), (x2, _) = on_chart(OUTAGE[0], 0), on_chart(OUTAGE[1], 0)
    d.polygon([(x1, 42), (x2, 42), (x2, 330), (x1, 330)], "#fcf0db")
    d.text((x1 + x2) / 2, 58, "no GPS", 11, AMBER)
    for meters in range(0, 9, 2):
        d.line([on_chart(0, meters), on_chart(98, meters)], "#e3e8eb", 1)
        d.text(482, on_chart(0, meters)[1] + 4, f"{meters} m", 11, anchor="end")
    for seconds in range(0, 100, 20):
        d.text(on_chart(seconds, 0)[0], 348, f"{seconds} s", 11)
    d.line([on_chart(row[0], row[3]) for row in rows], RED, 1.8)
    d.line([on_chart(row[0], row[2]) for row in rows], BLUE, 1.8)
    for x, color, words in ((530, RED, "protection level (10^-5 per hour)"), (735, BLUE, "true error")):
        d.dot(x, 366, 4, color)
        d.text(x + 9, 370, words, 11, anchor="start")
    return d


DRAWINGS: dict[str, Callable[[], Drawing]] = {
    "data-flow": data_flow,
    "filter": filter_flow,
    "delayed-measurement": delayed_measurement,
    "raptor-frames": raptor_frames,
    "drive": drive,
}


def main() -> int:
    """Write the images that are named, or all."""
    for name in sys.argv[1:] or DRAWINGS:
        (IMAGES / f"{name}.svg").write_text(DRAWINGS[name]().svg(), encoding="utf-8")
        print(f"docs/images/{name}.svg")
    return 0


if __name__ == "__main__":
    sys.exit(main())
