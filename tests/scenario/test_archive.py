"""Archives on real processes: the same bytes after kills, stops, a full disk and on another cluster; its readers."""

from __future__ import annotations

import json
import re
import resource
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import fsspec
import psutil
import pyarrow.parquet as pq
import pytest
import yaml
from fsspec.implementations.memory import MemoryFileSystem
from support_lcm import end_process, invoke
from support_recordings import REPOSITORY
from support_tuning import write_simulated_log

from modelserver.config.vehicle_file import load_config
from modelserver.server.recordings import CSV_HEADER
from modelserver.server.vehicle import load_vehicle
from mstools import cli
from mstools.archive.fleet import read_drives
from mstools.archive.logs import find_logs
from mstools.archive.storage import Storage, digest
from mstools.archive.tables import SCHEMA_VERSION, TABLES
from mstools.archive.task import Task, run_task
from mstools.commands.tune import PARTS, EvaluationJob, evaluate, open_pool

pytestmark = pytest.mark.slow

PROGRAM = "from mstools.cli import main; main()"
SECONDS = (20.0, 24.0, 28.0, 70.0, 12.0, 13.0, 14.0, 15.0)
"""Lengths of the logs, as many as a comparison needs. The longest is read for a second: its worker can be killed."""

TIMEOUT_S = 60.0


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("logs")
    for number, seconds in enumerate(SECONDS):
        write_simulated_log(folder, seconds)[0].rename(folder / f"drive{number}.lcm")
    return folder


@pytest.fixture(scope="module")
def vehicle() -> Path:
    return REPOSITORY / "config" / "raptor" / "vehicle.yaml"


@pytest.fixture(scope="module")
def reference(logs: Path, vehicle: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The archive of the logs, made in one go."""
    out = tmp_path_factory.mktemp("reference") / "archive"
    assert run(logs, vehicle, out) == (0, {"written": len(SECONDS), "unchanged": 0, "failed": 0})
    return out


def start(*words: Any, **more: Any) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", PROGRAM, "archive", *map(str, words)]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True, **more
    )


def run(logs: Path, vehicle: Path, out: Path, *more: Any) -> tuple[int, dict[str, int]]:
    """Run to the end; return exit code and number of logs by state."""
    process = start("run", logs, "-c", vehicle, "--out", out, "--workers", 2, "--json", *more)
    printed, errors = process.communicate(timeout=TIMEOUT_S)
    assert printed, errors
    return process.returncode, {key: json.loads(printed)[key] for key in ("written", "unchanged", "failed")}


def read_bytes(archive: Path) -> dict[str, bytes]:
    return {str(path.relative_to(archive)): path.read_bytes() for path in archive.rglob("*.parquet")}


def read_table(archive: Path, table: str) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = pq.read_table(archive / table).to_pylist()
    return rows


def call(*words: Any) -> tuple[int, str, str]:
    """Run a command here; return exit code and output."""
    done = invoke("", "archive", *words)
    return done.returncode, done.stdout, done.stderr


def wait_for(condition: Callable[[], Any]) -> Any:
    deadline = time.monotonic() + TIMEOUT_S
    while not (found := condition()):
        assert time.monotonic() < deadline, "not in time"
        time.sleep(0.005)
    return found


def wait_for_draft(out: Path) -> None:
    """Wait until a log is being replayed: its draft is there."""
    wait_for(lambda: (out / ".drafts").is_dir() and any((out / ".drafts").iterdir()))


def test_given_an_archive_when_run_again_then_nothing_is_written(logs: Path, vehicle: Path, reference: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in reference.rglob("*.parquet")}
    assert run(logs, vehicle, reference) == (0, {"written": 0, "unchanged": len(SECONDS), "failed": 0})
    assert {path: path.stat().st_mtime_ns for path in reference.rglob("*.parquet")} == before


def test_given_an_archive_then_its_tables_have_what_replay_computes(
    logs: Path, vehicle: Path, reference: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = logs / "drive3.lcm"
    with pytest.raises(SystemExit):
        cli.main(["replay", str(log), "-c", str(vehicle), "--poses", str(tmp_path / "p.csv"), "--rate", "10", "--json"])
    replayed = json.loads(capsys.readouterr().out)
    (drive,) = [row for row in read_table(reference, "drives") if row["log"] == str(log)]
    assert (drive["poses"], drive["valid"], drive["messages"]) == (
        replayed["poses"],
        replayed["valid"],
        replayed["events"],
    )
    assert 0.5 * drive["poses"] < drive["valid"] < drive["poses"]
    assert drive["seconds"] == pytest.approx(replayed["seconds"])
    assert 100.0 < drive["distance"] < 3.0 * SECONDS[3]
    lines = (tmp_path / "p.csv").read_text().splitlines()
    poses = [row for row in read_table(reference, "poses") if row["log"] == str(log)]
    assert len(poses) == len(lines) - 1
    assert [f"{row['easting']:.5f}" for row in poses] == [line.split(",")[1] for line in lines[1:]]
    invalid = sum(row["seconds"] for row in read_table(reference, "events") if row["kind"] == "invalid")
    of_metrics = sum(row["value"] for row in read_table(reference, "metrics") if row["name"] == "valid_seconds")
    total = sum(row["poses"] for row in read_table(reference, "drives")) / 10.0
    assert invalid + of_metrics == pytest.approx(total, abs=0.1 * 2 * len(SECONDS))


def test_given_killed_workers_then_no_log_is_lost_and_the_bytes_are_the_same(
    logs: Path, vehicle: Path, reference: Path, tmp_path: Path
) -> None:
    out = tmp_path / "archive"
    process = start("run", logs, "-c", vehicle, "--out", out, "--workers", 2, "--json")
    wait_for_draft(out)
    workers = [
        each
        for each in psutil.Process(process.pid).children(recursive=True)
        if "spawn_main" in " ".join(each.cmdline())
    ]
    assert len(workers) == 2
    for each in workers:
        each.kill()
    printed, errors = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 0, errors
    assert json.loads(printed)["written"] + json.loads(printed)["unchanged"] == len(SECONDS)
    assert read_bytes(out) == read_bytes(reference)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_given_a_run_that_was_stopped_when_run_again_then_the_bytes_are_the_same(
    logs: Path, vehicle: Path, reference: Path, tmp_path: Path, number: signal.Signals
) -> None:
    out = tmp_path / "archive"
    process = start("run", logs, "-c", vehicle, "--out", out, "--workers", 2)
    wait_for_draft(out)
    children = psutil.Process(process.pid).children(recursive=True)
    process.send_signal(number)
    _, errors = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == (130 if number == signal.SIGINT else -number)
    assert "Traceback" not in errors
    psutil.wait_procs(children, TIMEOUT_S)
    code, counts = run(logs, vehicle, out)
    assert (code, counts["failed"]) == (0, 0)
    assert read_bytes(out) == read_bytes(reference)
    assert not any((out / ".drafts").iterdir())


def test_given_a_disk_that_is_full_then_the_run_ends_with_the_reason_and_the_next_one_completes_it(
    logs: Path, vehicle: Path, reference: Path, tmp_path: Path
) -> None:
    out = tmp_path / "archive"
    largest = max(path.stat().st_size for path in reference.rglob("*.parquet"))

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (largest // 2, resource.RLIM_INFINITY))

    process = start("run", logs, "-c", vehicle, "--out", out, "--workers", 2, preexec_fn=limit)
    _, errors = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 1
    assert re.search(r"cannot be written: .*free space or permission, and run again", errors), errors
    assert "Traceback" not in errors
    assert run(logs, vehicle, out)[0] == 0
    assert read_bytes(out) == read_bytes(reference)


def test_given_a_changed_log_or_setting_then_only_what_changed_is_written(
    logs: Path, vehicle: Path, reference: Path, tmp_path: Path
) -> None:
    folder, out = tmp_path / "logs", tmp_path / "archive"
    shutil.copytree(logs, folder)
    assert run(folder, vehicle, out)[1]["written"] == len(SECONDS)
    before = read_bytes(out)
    shutil.copy(folder / "drive1.lcm", folder / "drive0.lcm")
    assert run(folder, vehicle, out)[1] == {"written": 1, "unchanged": len(SECONDS) - 1, "failed": 0}
    after = read_bytes(out)
    assert len(after) == len(before)
    assert len(after.keys() - before.keys()) == 6
    assert run(folder, vehicle, out, "--rate", 5)[1]["written"] == len(SECONDS)
    assert len(read_bytes(out)) == len(before)
    assert sum(row["poses"] for row in read_table(out, "drives")) == len(read_table(out, "poses"))


def test_given_damaged_and_missing_parts_then_each_log_is_a_row_with_its_error_and_what_was_read(
    logs: Path, vehicle: Path, tmp_path: Path
) -> None:
    folder, out = tmp_path / "logs", tmp_path / "archive"
    folder.mkdir()
    content = (logs / "drive3.lcm").read_bytes()
    (folder / "damaged.lcm").write_bytes(content[:200_000] + bytes(3000) + content[203_000:])
    (folder / "cut.lcm").write_bytes(content[: len(content) // 2 + 5])
    (folder / "zeros.lcm").write_bytes(bytes(5000))
    (folder / "empty.lcm").write_bytes(b"")
    (folder / "notes.md").write_text("no log")
    code, counts = run(folder, vehicle, out)
    assert (code, counts) == (1, {"written": 0, "unchanged": 0, "failed": 4})
    rows = {Path(row["log"]).name: row for row in read_table(out, "drives")}
    assert "are no event and were skipped" in rows["damaged.lcm"]["error"]
    assert rows["damaged.lcm"]["seconds"] == pytest.approx(SECONDS[3], abs=1.0)
    assert "truncated" in rows["cut.lcm"]["error"]
    assert rows["cut.lcm"]["seconds"] == pytest.approx(0.5 * SECONDS[3], abs=3.0)
    assert rows["cut.lcm"]["poses"] > 100
    assert rows["zeros.lcm"]["error"] == "not an LCM event log: no event in 5000 bytes"
    assert rows["empty.lcm"]["error"] == "the log is empty"
    # what is known to be damaged is not read again
    assert run(folder, vehicle, out)[1]["unchanged"] == 4


@contextmanager
def dask_cluster() -> Iterator[str]:
    """Run a scheduler and two workers as processes of their own; give the scheduler's address."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{probe.getsockname()[1]}"
    python = [sys.executable, "-m", "dask"]
    quiet: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    processes = [subprocess.Popen([*python, "scheduler", "--host", address, "--no-dashboard", "--no-show"], **quiet)]
    try:
        processes += [
            subprocess.Popen(
                [*python, "worker", address, "--nthreads", "1", "--no-nanny", "--host", "127.0.0.1", "--no-dashboard"],
                **quiet,
            )
            for _ in range(2)
        ]
        wait_for(lambda: _count_workers(address) == 2)
        yield address
    finally:
        for each in processes[::-1]:
            end_process(each)


def _count_workers(address: str) -> int:
    from distributed import Client

    with suppress(OSError), Client(address, timeout=1, set_as_default=False) as client:
        return len(client.scheduler_info()["workers"])
    return 0


def test_given_a_cluster_of_its_own_then_the_bytes_are_the_same_and_tune_scores_the_same(
    logs: Path, vehicle: Path, reference: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "archive"
    with dask_cluster() as address:
        process = start("run", logs, "-c", vehicle, "--out", out, "--scheduler", address)
        _, errors = process.communicate(timeout=TIMEOUT_S)
        assert process.returncode == 0, errors
        assert read_bytes(out) == read_bytes(reference)
        jobs = [
            EvaluationJob(logs / "drive0.lcm", vehicle, part, (("uere", uere),))
            for part in PARTS
            for uere in (2.0, -1.0)
        ]
        with open_pool(address) as runs:
            found = runs(jobs)
        assert found == [evaluate(jobs[0]), None, evaluate(jobs[2]), None]
    monkeypatch.setattr("mstools.archive.cluster.CONNECT_S", 0.5)
    code, _, err = call("run", logs, "-c", vehicle, "--out", out, "--scheduler", address)
    assert code == 1
    assert "no scheduler answers" in err


def test_given_a_journal_a_bag_a_list_and_a_pattern_then_each_is_one_log(
    logs: Path, vehicle: Path, tmp_path: Path
) -> None:
    journal = tmp_path / "journal-Raptor"
    journal.mkdir()
    shutil.copy(logs / "drive0.lcm", journal / "journal-00000000.lcm")
    shutil.copy(logs / "drive1.lcm", journal / "journal-00000001.lcm")
    with pytest.raises(SystemExit):
        cli.main(["export", str(logs / "drive2.lcm"), str(tmp_path / "drive2.mcap"), "-c", str(vehicle)])
    (tmp_path / "list.txt").write_text(f"# of the day\n{logs}/drive[01].lcm\njournal-Raptor\ndrive2.mcap\n")
    out = tmp_path / "archive"
    assert run(tmp_path / "list.txt", vehicle, out, f"file://{logs}/drive0.lcm")[1]["written"] == 4
    rows = {Path(row["log"]).name: row for row in read_table(out, "drives")}
    assert rows.keys() == {"drive0.lcm", "drive1.lcm", "journal-Raptor", "drive2.mcap"}
    assert rows["journal-Raptor"]["messages"] == rows["drive0.lcm"]["messages"] + rows["drive1.lcm"]["messages"]
    assert rows["drive2.mcap"]["valid"] > 0


class ObjectStore(MemoryFileSystem):
    """As S3 by s3fs: its order of arguments, refused ranges, errors of its own."""

    protocol = "objects"
    store: ClassVar[dict[str, Any]] = {}
    pseudo_dirs: ClassVar[list[str]] = [""]
    offline: ClassVar[set[str]] = set()

    @classmethod
    def _strip_protocol(cls, path: str) -> str:
        return str(super()._strip_protocol(path.replace("objects://", "memory://")))

    def cat_file(self, path: str, version_id: str | None = None, start: int = 0, end: int | None = None) -> Any:
        size = self.info(path)["size"]
        if version_id is not None or start >= size:
            raise OSError(22, "The requested range is not satisfiable")
        return super().cat_file(path, start, end)

    def get_file(self, rpath: str, lpath: str, **_: Any) -> None:
        if rpath in self.offline:
            raise RuntimeError("could not connect to the endpoint")
        super().get_file(rpath, lpath)


def test_given_object_storage_then_its_logs_are_found_fetched_and_written_there(logs: Path, vehicle: Path) -> None:
    fsspec.register_implementation("objects", ObjectStore, clobber=True)
    fs = fsspec.filesystem("objects")
    for name, source in (("a/0.lcm", 4), ("a/lcmlog.01", 5), ("b.lcm", 6)):
        fs.put_file(str(logs / f"drive{source}.lcm"), f"/fleet/{name}")
    fs.pipe({"/fleet/notes.md": b"short", "/fleet/empty.dat": b""})
    ObjectStore.offline.add("/fleet/b.lcm")
    found = find_logs(["objects://fleet"])
    assert found == ["objects:///fleet/a/0.lcm", "objects:///fleet/a/lcmlog.01", "objects:///fleet/b.lcm"]
    task = Task("", load_vehicle(load_config(vehicle), str(vehicle)), 10.0, "", "objects://archive")

    def archive() -> list[str]:
        with closing(Storage(task.out)) as storage:
            present = storage.prepare()
        return [run_task(replace(task, log=each, present=present.get(digest(each), ()))).state for each in found]

    assert archive() == ["written", "written", "failed"]
    drives = {each.log: each for each in read_drives(task.out)}
    assert "RuntimeError: could not connect to the endpoint" in drives[found[2]].error
    assert drives[found[0]].seconds == pytest.approx(SECONDS[4], abs=0.5)
    ObjectStore.offline.clear()
    assert archive() == ["unchanged", "unchanged", "written"]
    assert len(fs.find("/archive")) == len(TABLES) * len(found)


def test_given_a_worse_configuration_when_compared_then_the_exit_code_is_that_of_worse(
    logs: Path, vehicle: Path, reference: Path, tmp_path: Path
) -> None:
    worse = tmp_path / "vehicle.yaml"
    content = yaml.safe_load(vehicle.read_text(encoding="utf-8"))
    content["geometry"] = str(vehicle.parent / content["geometry"])
    # smaller than the sigma of any fix
    content["localization"]["filter"]["maximum_sigma"] = 0.001
    worse.write_text(yaml.safe_dump(content), encoding="utf-8")
    assert run(logs, worse, tmp_path / "worse")[0] == 0
    code, out, _ = call("compare", reference, tmp_path / "worse")
    assert code == 3, out
    assert re.search(r"invalid +% of the time.* worse$", out, re.MULTILINE)
    code, out, _ = call("compare", tmp_path / "worse", reference)
    assert code == 0, out
    code, out, _ = call("compare", reference, reference, "--json")
    found = json.loads(out)
    assert (code, found["worse"], found["pairs"]) == (0, False, len(SECONDS))
    assert {each["low"] for each in found["figures"]} == {each["high"] for each in found["figures"]} == {0.0}


def test_given_an_archive_then_the_page_has_its_drives_and_links_to_reports_on_demand(
    logs: Path, vehicle: Path, reference: Path, tmp_path: Path
) -> None:
    page = tmp_path / "page.html"
    code, out, _ = call("report", reference, "-o", page)
    assert code == 0
    text = page.read_text()
    assert all(f">drive{number}.lcm<" in text for number in range(len(SECONDS)))
    assert 'href="page-drives' not in text
    code, out, _ = call("report", reference, "-o", page, "-c", vehicle, "--drive", "drive2.lcm", "--worst", 1)
    assert code == 0, out
    links = re.findall(r'href="(page-drives/[^"]+)"', page.read_text())
    assert len(links) == 2
    assert all("Replay report" in (tmp_path / link).read_text() for link in links)
    code, _, err = call("report", reference, "-o", page, "-c", vehicle, "--drive", "drive9.lcm")
    assert (code, err) == (1, "modelserver: drive9.lcm: no drive of the archive; did you mean drive7.lcm?\n")


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("report", "nothing"), "no archive there"),
        (("run", "nothing.lcm", "-c", "VEHICLE", "--out", "archive"), "nothing.lcm: No such file or directory"),
        (("run", "folder", "-c", "VEHICLE", "--out", "archive"), "folder: no recording there"),
        (("run", "folder/*.lcm", "-c", "VEHICLE", "--out", "archive"), r"folder/*.lcm: no recording there"),
        (("run", "nowhere://a.lcm", "-c", "VEHICLE", "--out", "archive"), "nowhere"),
    ],
)
def test_given_no_input_then_the_error_names_it(
    words: tuple[str, ...], expected: str, vehicle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    code, _, err = call(*(str(vehicle) if each == "VEHICLE" else each for each in words))
    assert code == 1
    assert err.startswith("modelserver: ")
    assert expected in err
    assert err.count("\n") == 1


def test_given_an_archive_that_another_run_writes_then_the_second_one_is_refused(
    logs: Path, vehicle: Path, tmp_path: Path
) -> None:
    out = tmp_path / "archive"
    process = start("run", logs, "-c", vehicle, "--out", out, "--workers", 1)
    try:
        wait_for_draft(out)
        code, _, err = call("run", logs, "-c", vehicle, "--out", out)
        assert (code, "another run writes to it" in err) == (1, True)
    finally:
        end_process(process)


def test_given_the_page_on_archives_then_it_has_the_columns_of_each_table() -> None:
    """Its readers (pandas, polars, DuckDB) are run by test_docs_commands.py."""
    text = (REPOSITORY / "docs" / "archives.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| `(\w+)` \| [^|]+ \| ([^|]+) \|$", text, re.MULTILINE))
    assert rows.keys() == TABLES.keys()
    assert f"Schema {SCHEMA_VERSION};" in text
    for name, schema in TABLES.items():
        columns = [each for each in schema.names if each not in ("log", "time")]
        if name == "poses":
            assert columns == CSV_HEADER.split(",")[1:]
        else:
            assert [each for each in re.findall(r"`(\w+)`", rows[name]) if each in columns] == columns
