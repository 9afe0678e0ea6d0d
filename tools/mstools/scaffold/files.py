"""Geometry, vehicle file and DBC of a new vehicle, with comments; what must be measured is marked MEASURE."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from modelserver.messages import GpsSample, ImuSample
from msdrivers.registry import CanSettings, DeviceKind, ModbusSettings, SerialSettings, TcpSettings
from mstools.scaffold.guesses import FrameChoices, Mount
from mstools.scaffold.templates import Place, VehicleTemplate

MARK: Final = "MEASURE"
"""Word in the comment of each line that must be adapted to the vehicle."""

GEOMETRY_FILE, VEHICLE_FILE, DBC_FILE = "geometry.yaml", "vehicle.yaml", "wheels.dbc"


@dataclass(frozen=True, slots=True)
class Device:
    """A device of the new vehicle and its line: the path of a port, a CAN channel, or HOST:PORT."""

    kind: DeviceKind
    line: str

    @property
    def line_key(self) -> str:
        return find_line_key(self.kind, self.line)


def find_line_key(kind: DeviceKind, line: str) -> str:
    """Return the key of a line in a driver's section: by its form, where the kind has several."""
    keys = {SerialSettings: "port", TcpSettings: "address", CanSettings: "can", ModbusSettings: "address"}
    if SerialSettings in kind.lines and TcpSettings in kind.lines:
        is_address = "/" not in line and ":" in line
        return "address" if is_address else "port"
    return keys[kind.lines[0]]


@dataclass(frozen=True, slots=True)
class NewVehicle:
    """What is on a new vehicle.

    `head` is the pan-tilt head below the camera; `given` are the frames in a geometry that exists.
    """

    name: str
    template: VehicleTemplate
    gps: Device | None = None
    imu: Device | None = None
    wheels: Device | None = None
    has_camera: bool = False
    head: Device | None = None
    given: FrameChoices | None = None

    @property
    def mounts(self) -> FrameChoices:
        """The frames of the vehicle: those in a geometry that exists, else those of `make_geometry`."""
        if self.given is not None:
            return self.given
        wheels = {name: Mount(f"{self.body}:{_frame_of_wheel(name)}") for name in self.template.wheels}
        base, gps, imu = (Mount(f"{self.body}:{frame}") for frame in ("Base", "Antenna", "ImuUnit"))
        return FrameChoices(base, gps, imu, wheels)

    @property
    def body(self) -> str:
        words = "".join(character if character.isalnum() else " " for character in self.name).split()
        name = "".join(word[:1].upper() + word[1:] for word in words) or "Vehicle"
        return f"{name}Vehicle" if name in ("Camera", "Head") else name


def make_geometry(vehicle: NewVehicle) -> str:
    """Return the text of the geometry file."""
    template, body = vehicle.template, vehicle.body

    def frame(name: str, place: Place, comment: str, more: str = "") -> str:
        x, y, z = place
        return f"      {name}: {{xyz: [{x:g}, {y:g}, {z:g}]{more}}}   # {comment}"

    lines = [
        "modelserver: geometry/1",
        f"name: {vehicle.name}",
        "",
        "# Axes: x forward, y left, z up. Meters and degrees. A frame is given in the coordinates of its body; the",
        f"# origin of {body} is the frame Base, {template.base}.",
        f"# A line with {MARK} has a typical length: measure it on your vehicle, and remove the word.",
        "",
        "defaults:",
        f"  sigma: {{xyz: 0.02, rpy_deg: 1}}   # {MARK}: how well you measured, one standard deviation",
        "",
        "bodies:",
        f"  {body}:",
        "    frames:",
        f"      Base: {{}}   # {template.base}",
    ]
    if vehicle.wheels is not None:
        for name, place in template.wheels.items():
            lines.append(frame(_frame_of_wheel(name), place, f"{MARK}: where the wheel touches the ground"))
    if vehicle.gps is not None:
        lines.append(frame("Antenna", template.antenna, f"{MARK}: phase center of the antenna"))
    if vehicle.imu is not None:
        comment = f"{MARK}: the unit and its own axes; here x forward, y left, z up"
        more = ", rpy_deg: [0, 0, 0]"
        if vehicle.imu.kind.has_z_down:
            more, comment = ", rpy_deg: [180, 0, 0]", f"{MARK}: the unit and its own axes; here x forward, z down"
        lines.append(frame("ImuUnit", template.imu, comment, more))
    if vehicle.has_camera:
        lines += [
            frame("CameraMount", template.camera, f"{MARK}: where the {'head' if vehicle.head else 'camera'} is fixed"),
            *(_HEAD_BODY if vehicle.head else ()),
            "  Camera:",
            "    frames:",
            "      Mount: {}",
            "      # the optical frame: z ahead out of the lens, x right, y down in the image",
            f"      Lens: {{xyz: [0.03, 0, 0.02], rpy_deg: [-90, 0, -90]}}   # {MARK}: the entrance pupil",
            "",
            "constraints:",
            *(_make_head_joints(body) if vehicle.head else _fix_camera(body)),
        ]
    return "\n".join(lines) + "\n"


_HEAD_BODY: Final = (
    "  Head:   # the part between the two axes of the pan-tilt head",
    "    frames:",
    "      Base: {}",
    f"      TiltAxis: {{xyz: [0, 0, 0.05]}}   # {MARK}: height of the tilt axis above the mount",
)


def _fix_camera(body: str) -> Iterator[str]:
    yield "  CameraFixed:"
    yield f'    {{from: "{body}:CameraMount", to: "Camera:Mount", rpy_deg: [0, 0, 0]}}   # {MARK}: its tilt'


def _make_head_joints(body: str) -> Iterator[str]:
    yield "  # positions come from the driver head; positive turns about the axis: to the left, and up"
    for name, base, moved, axis, limits in (
        ("Pan", f"{body}:CameraMount", "Head:Base", "[0, 0, 1]", "[-170, 170]"),
        ("Tilt", "Head:TiltAxis", "Camera:Mount", "[0, -1, 0]", "[-60, 60]"),
    ):
        yield f"  {name}:   # {MARK}: sense of its axis, limits, accuracy"
        yield f'    from: "{base}"'
        yield f'    to: "{moved}"'
        yield f"    joint: {{type: revolute, axis: {axis}, limits_deg: {limits}, sigma_deg: 0.5}}"


def _frame_of_wheel(name: str) -> str:
    return "".join(word.capitalize() for word in name.split("_")) + "Wheel"


def make_vehicle(vehicle: NewVehicle) -> str:
    """Return the text of the vehicle file."""
    template, mounts = vehicle.template, vehicle.mounts
    lines = [
        f"# {vehicle.name}: {template.summary}.",
        "# Check with: modelserver check vehicle.yaml. All keys: docs/vehicle-file.md.",
        *(f"# {line}" for line in template.note.splitlines()),
        f"vehicle: {vehicle.name}",
        f"geometry: {GEOMETRY_FILE}",
        f'base_frame: "{mounts.base.frame}"{_mark(mounts.base) or "   # POSE describes this frame"}',
        *(f'rolling_frame: "{each.frame}"{_mark(each)}' for each in (mounts.rolling,) if each is not None),
        "state_directory: state   # the origin, and the state for the next start",
        "journal: {directory: journal, megabytes: 256}   # all inputs and outputs, to replay; the oldest are deleted",
    ]
    if sensors := list(_list_sensors(vehicle, mounts)):
        lines += ["", "sensors:", *sensors]
    if template.settings:
        lines += [
            "",
            "localization:",
            "  filter:",
            *(f"    {key}: {value:g}" for key, value in template.settings.items()),
        ]
    if drivers := list(_list_drivers(vehicle)):
        lines += [
            "",
            "# modelserver up runs the service and all of these; modelserver driver --list shows the ports.",
            "drivers:",
        ]
        lines += drivers
    return "\n".join(lines) + "\n"


def _list_sensors(vehicle: NewVehicle, mounts: FrameChoices) -> Iterator[str]:
    for name, device, mount in (("gps", vehicle.gps, mounts.gps), ("imu", vehicle.imu, mounts.imu)):
        if device is not None and mount is not None:
            yield f'  {name}: {{channel: {name.upper()}, frame: "{mount.frame}"}}{_mark(mount)}'
    if vehicle.wheels is not None:
        yield "  wheels:"
        yield "    channel: WHEELS"
        yield f"    kinematics: {vehicle.template.kinematics}"
        yield "    frames:"
        yield from (f'      {name}: "{mount.frame}"{_mark(mount)}' for name, mount in mounts.wheels.items())


def _mark(mount: Mount) -> str:
    return f"   # {MARK}: {mount.note}" if mount.note else ""


def _list_drivers(vehicle: NewVehicle) -> Iterator[str]:
    for name, device in (("gps", vehicle.gps), ("imu", vehicle.imu)):
        if device is not None:
            yield f"  {name}:   # {device.kind.description}"
            yield f"    device: {device.kind.name}"
            yield f"    {device.line_key}: {_quote(device.line)}   # {MARK}: its line on this machine"
            yield from (f"    {line}" for line in device.kind.example)
    if vehicle.wheels is not None:
        yield f"  wheels:   # {vehicle.wheels.kind.description}"
        yield f"    device: {vehicle.wheels.kind.name}"
        channel = vehicle.wheels.line
        yield f"    can: {_quote(channel)}   # {MARK}: sudo ip link set {channel} up type can bitrate 500000"
        yield f"    dbc: {DBC_FILE}   # {MARK}: the frames that your controller sends; this one is an example"
        yield f"    max_speed: {vehicle.template.max_speed:g}   # m/s: a higher one is damage"
        yield "    wheels:"
        for name in vehicle.template.wheels:
            yield f"      {name}:"
            yield f"        count:   # {MARK}: the distance of one count is circumference / counts per turn"
            yield f"          {{signal: WheelCounts.{_signal_of_wheel(name)}, meters_per_count: 0.001}}"

    if vehicle.head is not None:
        yield f"  head:   # {vehicle.head.kind.description}"
        yield f"    device: {vehicle.head.kind.name}"
        yield f"    {vehicle.head.line_key}: {_quote(vehicle.head.line)}   # {MARK}: its line on this machine"
        yield f"    baud: 57600   # {MARK}: its rate"
        yield "    columns: 2"
        yield f"    joints:   # {MARK}: the columns of its lines, here degrees such as 12.5,-3.25"
        yield "      Pan: {column: 0, scale: 0.0174533}"
        yield "      Tilt: {column: 1, scale: 0.0174533}"


def _quote(line: str) -> str:
    return f'"{line}"' if ":" in line else line


def _signal_of_wheel(name: str) -> str:
    return "".join(word.capitalize() for word in name.split("_")) + "Count"


def make_dbc(vehicle: NewVehicle) -> str:
    """Return the text of an example DBC file: a 16-bit counter for each wheel, up when it rolls forward."""
    signals = "\n".join(
        f' SG_ {_signal_of_wheel(name)} : {16 * number}|16@1+ (1,0) [0|65535] "" Computer'
        for number, name in enumerate(vehicle.template.wheels)
    )
    head = f'VERSION "{vehicle.name}"\n\nNS_ :\n\nBS_:\n\nBU_: Controller Computer\n\n'
    return f"{head}BO_ 256 WheelCounts: {2 * len(vehicle.template.wheels)} Controller\n{signals}\n"


def list_marks(folder: Path, files: Iterator[str] | tuple[str, ...]) -> Iterator[str]:
    """Yield `file:line: what` for each line of some files that must be adapted."""
    for name in files:
        for number, line in enumerate((folder / name).read_text(encoding="utf-8").splitlines(), 1):
            head, mark, what = line.partition(f"# {MARK}: ")
            if mark:
                yield f"{name}:{number}: {head.split(':')[0].strip(' {')}: {what}"


def list_kinds(kinds: Mapping[str, DeviceKind], sample: type[GpsSample] | type[ImuSample]) -> dict[str, DeviceKind]:
    return {name: kind for name, kind in kinds.items() if kind.sample is sample}
