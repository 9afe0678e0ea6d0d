"""What the viewer shows: a geometry file, a log, or a running service; a `Drive` with a client that answers queries."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Final

from modelserver.client.mirror import LocalPlatform
from modelserver.client.mirror_state import HISTORY_S, MirrorReceiver, MirrorState
from modelserver.client.remote import Platform
from modelserver.dynamics.stability import DynamicsSettings
from modelserver.errors import RecordingError
from modelserver.formats.yaml_geometry import ModelSnapshot
from modelserver.geometry.joint import Joint, coordinate_names
from modelserver.geometry.model import Model
from modelserver.messages import JointSample, JointsSample, SensorHeader
from modelserver.server.recordings import LOOKED_AT, measure
from modelserver.wire.codec import encode
from modelserver.wire.eventlog import LogEvent
from modelserver.wire.provider import open_lcm, resolve_url
from mstools.edit import EditedFile, EditSession
from mstools.meshes import MeshFolders
from mstools.recordings.drive import Drive, follow_bus
from mstools.recordings.log_platform import LogPlatform, scan_log
from mstools.terminal.output import load_given_model, read_with_progress

FILE_UTIME: Final = 10**15
"""Stamp of the first joint positions of a geometry file; each later one is a second later."""


BATCH_S: Final = 0.01
"""Pause between batches of messages, seconds: a quarter of a picture, and what a latency may be too large."""


@dataclass
class Source:
    """A drive and the client that answers queries on it. Read `drive` under `lock`; `close` ends what runs for it.

    `meshes` are the folders in which mesh files are looked up; `notes` are what is odd about a log. `set_joints`
    moves the joints of a geometry file, `set_model` shows it as edited; `dynamics` is the section of its vehicle file.
    """

    title: str
    drive: Drive
    answers: LocalPlatform | Platform
    meshes: MeshFolders = field(default_factory=MeshFolders)
    is_live: bool = False
    set_joints: Callable[[Mapping[str, float]], None] | None = None
    set_model: Callable[[Model], None] | None = None
    dynamics: DynamicsSettings | None = None
    notes: tuple[str, ...] = ()
    lock: threading.Lock = field(default_factory=threading.Lock)
    close: Callable[[], None] = lambda: None

    @property
    def has_time(self) -> bool:
        """Whether it changes with time: a log or a running service."""
        return not isinstance(self.answers, FilePlatform)


# --- geometry file


class FilePlatform(LocalPlatform):
    """Queries of a geometry, with the joints where they are set."""

    def __init__(self, model: Model, base_frame: str, where: str):
        self.where = where
        self._utime = FILE_UTIME
        self.set_model(model, base_frame)

    def set_model(self, model: Model, base_frame: str) -> None:
        """Answer with another geometry, with all joints at their defaults."""
        snapshot = ModelSnapshot("", model, base_frame, base_frame, HISTORY_S, "JOINTS")
        self._receiver = MirrorReceiver("", snapshot, True)

    def read_state(self) -> tuple[MirrorState, int]:
        return self._receiver.state, self._utime

    def set_joints(self, positions: Mapping[str, float]) -> None:
        """Set the positions of coordinates, radians and meters."""
        self._utime += 1_000_000
        samples = tuple([JointSample(name, position) for name, position in positions.items()])
        sample = JointsSample(SensorHeader(self._utime, "view", 0, self._utime), samples)
        self._receiver.feed("JOINTS", encode(sample), self._utime)


def list_coordinates(model: Model) -> list[tuple[str, Joint, int]]:
    """Return name, joint and number of each coordinate that can be set: those of joints that follow no other."""
    return [
        (name, each.joint, number)
        for each in model.joints.values()
        if each.joint.mimic is None
        for number, name in enumerate(coordinate_names(each.name, each.joint))
    ]


def open_geometry(
    path: Path, variables: Mapping[str, str], session: EditSession | None = None, packages: Sequence[Path] = ()
) -> Source:
    """Open a geometry file, or that of a vehicle file; one that is edited may have errors.

    `packages` are folders in which its meshes are looked up too.

    Raises GeometryError, ConfigError, OSError.
    """
    file = EditedFile.open(path) if session is None else session.file
    geometry, base_frame = file.path, file.config.base_frame if file.config is not None else ""
    model = load_given_model(geometry, variables) if session is None else session.drawn
    drive = Drive(keep_geometry=True)
    answers = FilePlatform(model, next((frame.full_name for body in model.bodies for frame in body), ""), f"in {path}")
    meshes = MeshFolders(geometry.resolve().parent, tuple(packages))
    dynamics = file.config.dynamics if file.config is not None else None
    source = Source(f"{model.name or path.name}", drive, answers, meshes, dynamics=dynamics)

    def set_joints(positions: Mapping[str, float]) -> None:
        answers.set_joints(positions)
        with source.lock:
            for name, position in positions.items():
                drive.set_joint(name, answers.read_state()[1], position)

    def set_model(shown: Model) -> None:
        frames = [frame.full_name for body in shown.bodies for frame in body]
        base = base_frame if base_frame in frames else next(iter(frames), "")
        answers.set_model(shown, base)
        with source.lock:
            drive.set_model(shown)
            drive.base_frame = base
            drive.joints.clear()
        set_joints({name: joint.default_position[number] for name, joint, number in list_coordinates(shown)})

    set_model(model)
    source.set_joints, source.set_model = set_joints, set_model
    return source


# --- log


class NoGeometry(LocalPlatform):
    """Queries of a log without geometry: none has an answer."""

    def __init__(self, where: str):
        self.where = where

    def read_state(self) -> tuple[MirrorState, int]:
        """Return that nothing is known."""
        return MirrorState(), 0


def open_log(path: Path, prefix: str = "", model: Path | None = None, packages: Sequence[Path] = ()) -> Source:
    """Open a log of the service; `model` is a geometry file in place of the log's, `packages` as for `open_geometry`.

    Raises RecordingError, GeometryError, OSError.
    """
    given = None if model is None else load_given_model(model, {})
    drive = Drive(prefix, given, keep_geometry=given is not None)

    def feed(event: LogEvent) -> LogEvent:
        drive.feed(event.channel, event.data, event.utime)
        return event

    with read_with_progress("reading", path) as (log, events):
        contents = scan_log(map(feed, events), prefix, with_geometry=given is None)
        notes = [*map(str, log.damage)]
        # reads the log from its beginning, and forgets the damage
        notes += measure(islice(log, LOOKED_AT)).describe()
    answers: LocalPlatform
    try:
        answers = LogPlatform(path, prefix, given, contents)
        drive.base_frame = drive.base_frame or answers.base_frame
    except RecordingError as error:
        if not drive.begin:
            raise
        if drive.poses.count:
            notes.append(f"only track, fixes and rates are shown: {error}")
        answers = NoGeometry(f"in {path}")
    if not drive.poses.count:
        notes.append("fixes and rates are shown; -c vehicle.yaml runs the localization on it, which has no pose yet")
    folder = model.resolve().parent if model is not None else None
    return Source(path.name, drive, answers, MeshFolders(folder, tuple(packages)), notes=tuple(notes))


# --- running service


def open_live(url: str, prefix: str, timeout: float, packages: Sequence[Path] = ()) -> Source:
    drive = Drive(prefix)
    answers = Platform(url, channel_prefix=prefix, timeout=timeout, retries=0, name="view")
    source = Source("live", drive, answers, MeshFolders(None, tuple(packages)), is_live=True)
    stop = threading.Event()
    bus = open_lcm(resolve_url(url))
    arguments = (bus, prefix, drive.feed, stop.is_set, source.lock, BATCH_S)
    listener = threading.Thread(target=follow_bus, args=arguments, name="view", daemon=True)
    listener.start()

    def close() -> None:
        stop.set()
        listener.join(2.0)
        answers.close()

    source.close = close
    return source
