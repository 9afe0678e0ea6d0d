"""`modelserver new`: the files of a new vehicle, from a few questions or options."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Final

import typer

from modelserver.errors import ModelServerError, find_nearest_names, quote
from modelserver.formats import check_file, save_model
from modelserver.geometry import Model
from modelserver.messages import GpsSample, ImuSample
from msdrivers.registry import KINDS, DeviceKind, SerialSettings
from mstools.commands.check import check_vehicle
from mstools.scaffold.files import (
    DBC_FILE,
    GEOMETRY_FILE,
    MARK,
    VEHICLE_FILE,
    Device,
    NewVehicle,
    list_kinds,
    list_marks,
    make_dbc,
    make_geometry,
    make_vehicle,
)
from mstools.scaffold.guesses import (
    GPS_WORDS,
    IMU_WORDS,
    FrameChoices,
    Mount,
    Wheel,
    add_wheel_frames,
    guess_base,
    guess_kind,
    guess_sensor,
    list_wheels,
    note_axes,
)
from mstools.scaffold.templates import TEMPLATES
from mstools.terminal.options import choose_name, option
from mstools.terminal.output import escape, print_problems, write_file

NONE: Final = "none"
"""Answer for a device that is not there."""

DEFAULT_PORT, DEFAULT_ADDRESS = "/dev/ttyUSB{}", "127.0.0.1:2947"
"""Lines of devices where this machine has none: gpsd has this address."""

DEFAULT_GPS, DEFAULT_IMU, DEFAULT_CAN = "ublox", "gx1", "can0"

MAX_NAME: Final = 40


def command(
    folder: Annotated[Path, typer.Argument(metavar="[DIR]", help="Folder for the files. Default: this one.")] = Path(),
    name: Annotated[str, option("--name NAME", "Name of the vehicle. Default: that of the folder.")] = "",
    vehicle: Annotated[str, option("--vehicle KIND", f"One of {', '.join(TEMPLATES)}.")] = "",
    gps: Annotated[
        str, option("--gps DEVICE[@LINE]", "GNSS receiver, e.g. ublox@/dev/ttyACM0 or novatel@10.0.0.7:3001; none.")
    ] = "",
    imu: Annotated[str, option("--imu DEVICE[@LINE]", "Inertial unit, e.g. gx1@/dev/ttyUSB1; none.")] = "",
    wheels: Annotated[str, option("--wheels CHANNEL", "CAN channel of the wheel encoders, e.g. can0; none.")] = "",
    camera: Annotated[bool | None, option("--camera/--no-camera", "Whether there is a camera.")] = None,
    pan_tilt: Annotated[
        str, option("--pan-tilt LINE", "Port of a pan-tilt head below the camera, e.g. /dev/ttyUSB2; none.")
    ] = "",
    urdf: Annotated[
        Path | None, option("--from-urdf FILE", "Take the geometry from this URDF or geometry file.")
    ] = None,
    base_frame: Annotated[str, option("--base-frame FRAME", "With --from-urdf: the frame of the pose.")] = "",
    gps_frame: Annotated[str, option("--gps-frame FRAME", "With --from-urdf: the phase center of the antenna.")] = "",
    imu_frame: Annotated[str, option("--imu-frame FRAME", "With --from-urdf: the inertial unit.")] = "",
    yes: Annotated[bool, option("--yes -y", "Ask nothing: what no option gives has its default.")] = False,
    force: Annotated[bool, option("--force", "Replace files that exist.")] = False,
) -> None:
    """Write the files of a new vehicle: geometry, vehicle file, and a DBC file if it has wheels on a CAN bus.

    Asks what is on the vehicle, and proposes the ports that are there. An option answers its question. The lengths in
    the files are typical ones; what must be measured is marked and listed.

    \b
    Examples:
      modelserver new rover
      modelserver new rover --yes --vehicle skid --gps ublox@/dev/ttyACM0 --imu gx1@/dev/ttyUSB0 --wheels can0 --camera
      modelserver new arm --from-urdf arm.urdf --base-frame base_link:Origin
    """
    for option_name, given in (("--base-frame", base_frame), ("--gps-frame", gps_frame), ("--imu-frame", imu_frame)):
        if given and urdf is None:
            raise typer.BadParameter("goes with --from-urdf", param_hint=option_name)
    has_head = pan_tilt not in ("", NONE)
    if has_head and (camera is False or urdf is not None):
        raise typer.BadParameter("goes with --camera, and without --from-urdf", param_hint="--pan-tilt")
    camera = True if has_head else camera
    ask = Questions(is_asking=not yes and sys.stdin.isatty())
    model = None if urdf is None else _load_geometry(urdf)
    known = {name: f"{each.summary}" for name, each in TEMPLATES.items()}
    name = _check_name(ask.text("Name of the vehicle", name, folder.resolve().name or "vehicle"))
    base = None if model is None else Mount(base_frame) if base_frame else guess_base(model)
    turning = (
        () if model is None or base is None else list_wheels(model, _check_frame(model, base.frame, "--base-frame"))
    )
    kind = ask.choice(
        "Which kind of vehicle is it?", vehicle, known, guess_kind(turning) if turning else "skid", "--vehicle"
    )
    wanted = NewVehicle(
        name,
        TEMPLATES[kind],
        ask.device("GNSS receiver", gps, list_kinds(KINDS, GpsSample), DEFAULT_GPS, "--gps"),
        ask.device("Inertial unit", imu, list_kinds(KINDS, ImuSample), DEFAULT_IMU, "--imu"),
        ask.wheels(wheels, propose_can() if model is None or turning else NONE),
        model is None and ask.flag("Is there a camera?", camera),
    )
    if wanted.has_camera:
        wanted = dataclasses.replace(wanted, head=ask.head(pan_tilt))
    if model is not None and base is not None:
        model, mounts = find_mounts(model, base, wanted, turning, gps_frame, imu_frame)
        wanted = dataclasses.replace(wanted, given=mounts)
    files = {GEOMETRY_FILE: make_geometry(wanted) if model is None else save_model(model, "yaml").text}
    if wanted.wheels is not None:
        files[DBC_FILE] = make_dbc(wanted)
    files[VEHICLE_FILE] = make_vehicle(wanted)
    write_files(folder, files, force)
    show_result(folder, files)


class Questions:
    """The answers to questions: given by an option, else asked, else the default."""

    def __init__(self, *, is_asking: bool):
        self._is_asking = is_asking
        self._used: set[str] = set()

    def text(self, question: str, given: str, default: str) -> str:
        if given or not self._is_asking:
            return given or default
        return str(typer.prompt(question, default=default)).strip()

    def flag(self, question: str, given: bool | None) -> bool:
        if given is not None or not self._is_asking:
            return bool(given)
        return typer.confirm(question, default=False)

    def choice(self, question: str, given: str, known: Mapping[str, str], default: str, option_name: str) -> str:
        """Return one of the names in `known`, whose values describe them."""
        if given:
            return choose_name(given, known, "choice", option_name)
        if not self._is_asking:
            return default
        typer.echo(question)
        for each, text in known.items():
            typer.echo(f"  {each:<14}{text}")
        while (answer := self.text("Your choice", "", default)) not in known:
            near = find_nearest_names(answer, known)
            typer.echo(f"  {quote(answer, 40)} is none of these" + (f"; did you mean {near[0]}?" if near else ""))
        return answer

    def device(
        self, what: str, given: str, kinds: Mapping[str, DeviceKind], default: str, option_name: str
    ) -> Device | None:
        """Return a device and its line; None for none."""
        name, _, line = given.partition("@")
        known = {**{each: kind.description for each, kind in kinds.items()}, NONE: "there is none"}
        name = self.choice(f"{what}: which device?", name, known, default, option_name)
        if name == NONE:
            return None
        kind = kinds[name]
        line = self.text(f"{what}: its port", line, propose_line(kind, self._used))
        self._used.add(line)
        return Device(kind, line)

    def head(self, given: str) -> Device | None:
        """Return the pan-tilt head that carries the camera; None for none."""
        question = "Port of the pan-tilt head below the camera (none: it is fixed)"
        line = self.text(question, given, NONE)
        return None if line == NONE else Device(KINDS["text_joints"], line)

    def wheels(self, given: str, default: str) -> Device | None:
        """Return the wheels on a CAN bus; None for none."""
        channel = self.text("CAN channel of the wheel encoders (none: there are none)", given, default)
        return None if channel == NONE else Device(KINDS["wheels"], channel)


def propose_line(kind: DeviceKind, used: Collection[str]) -> str:
    """Return the port that a device is probably on: one with something plugged in, which no other device has."""
    if SerialSettings not in kind.lines:
        return DEFAULT_ADDRESS
    from msdrivers.links.serial_port import find_ports

    ports = [port.path for port in find_ports() if "USB" in port.path or "ACM" in port.path]
    return next(port for port in (*ports, *(DEFAULT_PORT.format(n) for n in range(9))) if port not in used)


def propose_can() -> str:
    """Return the first CAN interface of this machine, else a usual name."""
    from msdrivers.links.can_bus import list_can_interfaces

    return next(iter(list_can_interfaces()), DEFAULT_CAN)


def _check_name(name: str) -> str:
    if not (0 < len(name) <= MAX_NAME and all(each.isalnum() or each in "-_. " for each in name) and name[0].isalpha()):
        raise typer.BadParameter(
            f"{quote(name, 60)}: a name begins with a letter and has letters, digits, - and _, at most {MAX_NAME}",
            param_hint="--name",
        )
    return name


def _load_geometry(file: Path) -> Model:
    """Return the model of a URDF or another geometry file; print its problems. Raises ModelServerError."""
    model, problems = check_file(str(file))
    print_problems(problems)
    if model is None:
        raise ModelServerError(f"{escape(str(file))} has errors; nothing was written")
    return model


def find_mounts(
    model: Model, base: Mount, wanted: NewVehicle, turning: Sequence[Wheel], gps: str, imu: str
) -> tuple[Model, FrameChoices]:
    """Return the frames of what is on a vehicle, those given or guessed, and the model with those of its wheels.

    Raises typer.BadParameter, GeometryError.
    """

    def choose(given: str, words: tuple[str, ...], option_name: str) -> Mount:
        if given:
            return Mount(_check_frame(model, given, option_name))
        if guess := guess_sensor(model, words, base.frame):
            return guess
        names = list_frames(model)
        shown = ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
        raise typer.BadParameter(f"give the frame; the geometry has: {shown}", param_hint=option_name)

    mounts = FrameChoices(
        base,
        choose(gps, GPS_WORDS, "--gps-frame") if wanted.gps is not None else None,
        choose(imu, IMU_WORDS, "--imu-frame") if wanted.imu is not None else None,
    )
    if wanted.imu is not None and mounts.imu is not None and wanted.imu.kind.has_z_down:
        mounts = mounts._replace(imu=note_axes(model, mounts.imu, wanted.imu.kind.name, base.frame))
    if wanted.wheels is None:
        return model, mounts
    model, wheels, rolling = add_wheel_frames(model, base.frame, wanted.template, turning)
    return model, mounts._replace(wheels=wheels, rolling=rolling)


def list_frames(model: Model) -> list[str]:
    return [frame.full_name for body in model.bodies for frame in body.frames]


def _check_frame(model: Model, name: str, option_name: str) -> str:
    return choose_name(name, list_frames(model), "frame", option_name)


def write_files(folder: Path, files: Mapping[str, str], force: bool) -> None:
    """Write all files, or none if one exists. Raises ModelServerError, OSError."""
    there = [name for name in files if (folder / name).exists()]
    if there and not force:
        raise ModelServerError(f"{', '.join(str(folder / name) for name in there)} exists; give --force to replace it")
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        write_file(str(folder / name), text, replace=True)


def show_result(folder: Path, files: Mapping[str, str]) -> None:
    """Print what was written, what `check` finds, what must be measured, and what to do next."""
    for name in files:
        typer.echo(escape(f"written: {folder / name}"))
    _, problems = check_vehicle(str(folder / VEHICLE_FILE))
    print_problems(problems, err=False)
    if marks := list(list_marks(folder, tuple(files))):
        typer.echo(f"\nTo be measured or adapted, marked {MARK} in the files:")
        for mark in marks:
            typer.echo(escape(f"  {mark}"))
    typer.echo()
    where = "" if folder == Path() else f"cd {folder} && "
    typer.echo(escape(f"Next: {where}modelserver up --emulate     (no hardware needed; then modelserver status)"))
