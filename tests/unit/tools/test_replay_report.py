"""The report's page: valid, self-contained, small, and with the findings of a simulated drive."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support_recordings import HUSKY, drive, write_log
from support_report import read_answer, read_numbers
from support_tuning import write_simulated_log, write_vehicle

from benchmarks.rough_simulation import EncoderModel
from modelserver import extras
from modelserver.errors import ModelServerError
from modelserver.extras import make_install_command
from modelserver.simulation import WheelsModel
from mstools import cli
from mstools.report import charts

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    def replay(*arguments: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as end:
            cli.main(["replay", *(str(each) for each in arguments)])
        out, err = capsys.readouterr()
        return int(end.value.code or 0), out, err

    return replay


class Balanced(HTMLParser):
    """Checks that every tag is closed."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: object) -> None:
        if tag not in ("meta", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def whole(page: str) -> str:
    """Check that a page is self-contained HTML, and return it."""
    parser = Balanced()
    parser.feed(page)
    parser.close()
    assert parser.open == []
    shown = re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)
    assert not re.search(r"(src|href)=(?!\"#)|url\(|@import|<link|<script", shown)
    assert not re.search(r'[ ",](nan|inf)\b', shown)
    for script in re.findall(r'<script type="application/json">(.*?)</script>', page):
        figure = json.loads(script, parse_constant=pytest.fail)
        assert figure["data"]
        assert figure["layout"]["height"] > 50
    return page


@pytest.fixture(scope="module")
def eight(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return log and vehicle file of a figure-eight drive with one wheel that counts backward."""
    folder = tmp_path_factory.mktemp("eight")
    wheels = WheelsModel(encoder=EncoderModel(swapped=frozenset({"front_left"})))
    return write_simulated_log(folder, seconds=25.0, wheels_model=wheels)


@pytest.mark.slow
def test_given_a_drive_when_reported_then_the_page_is_whole_and_the_swapped_wheel_is_named(
    eight: tuple[Path, Path], tmp_path: Path, run: Run
) -> None:
    log, config = eight
    out = tmp_path / "report.html"
    code, words, err = run(log, "-c", config, "--report", out)
    assert (code, err) == (0, "")
    assert "Wheel front_left counts backward" in words
    page = whole(out.read_text())
    assert len(page) < 3_000_000
    for text in ("Wheel front_left counts backward", "gps_position, east, m", "Gyro bias", "Wheel scale", "fixes used"):
        assert text in page
    assert "phase aligned" in page
    # the answer is first, on the page and in the terminal
    answer = read_answer(out)
    assert re.fullmatch(r"Valid \d\d\.\d% of 25\.0 s, from \d\.\d s on without interruption", answer[0])
    assert "Main finding: Wheel front_left counts backward. Reverse the sign of this wheel" in answer[-1]
    printed = words.splitlines()
    assert printed[1 : 1 + len(answer)] == [answer[0], *(f"  {each}" for each in answer[1:])]


@pytest.mark.slow
def test_given_a_report_beside_poses_and_decisions_then_these_are_as_without_it(
    eight: tuple[Path, Path], tmp_path: Path, run: Run
) -> None:
    log, config = eight
    one = ["--poses", tmp_path / "a.csv", "--decisions", tmp_path / "a.jsonl", "--rate", 5]
    two = ["--poses", tmp_path / "b.csv", "--decisions", tmp_path / "b.jsonl", "--rate", 5]
    assert run(log, "-c", config, *one)[0] == 0
    assert run(log, "-c", config, *two, "--report", tmp_path / "r.html")[0] == 0
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()
    assert (tmp_path / "a.jsonl").read_bytes() == (tmp_path / "b.jsonl").read_bytes()
    assert (tmp_path / "r.html").stat().st_size > 10_000


@pytest.mark.slow
def test_given_raw_mode_then_there_is_a_page_without_innovations(tmp_path: Path, run: Run) -> None:
    config = write_vehicle(HUSKY, tmp_path, {"mode": "raw"})
    log = write_log(tmp_path / "drive.lcm", drive(20.0))
    assert run(log, "-c", config, "--report", tmp_path / "r.html")[0] == 0
    assert "No innovations" in whole((tmp_path / "r.html").read_text())


def test_given_a_log_without_fixes_then_the_page_has_no_pose(tmp_path: Path, run: Run) -> None:
    log = write_log(tmp_path / "drive.lcm", [each for each in drive(10.0) if each[1] == "IMU"])
    code, words, _ = run(log, "-c", HUSKY, "--report", tmp_path / "r.html")
    assert code == 0
    assert "Never valid in 10.0 s" in words
    assert "No pose in the world" in whole((tmp_path / "r.html").read_text())
    headline, reason, cause = read_answer(tmp_path / "r.html")
    assert headline == "Never valid in 10.0 s"
    assert reason == "Main reason: no usable GPS fix yet (NO_FIX), 100% of the 10.0 s without a valid pose."
    assert cause.startswith("Probable cause: No messages on channel GPS (sensors.gps). Correct the channel")


def test_given_standard_output_then_only_the_page_goes_there(tmp_path: Path, run: Run) -> None:
    log = write_log(tmp_path / "drive.lcm", drive(5.0))
    code, out, err = run(log, "-c", HUSKY, "--report", "-")
    assert code == 0
    whole(out)
    assert "report: -" in err


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--report", "r.html"], "--report needs the vehicle"),
        (["-c", str(HUSKY), "--report", "r.html", "--at-times", "t"], "--at-times need --poses"),
        (["-c", str(HUSKY), "--report", "r.html", "--speed", "2"], "are offline"),
        (["-c", str(HUSKY), "--report", "-", "--poses", "-"], "only one of"),
    ],
)
def test_given_options_that_do_not_go_together_then_usage(
    tmp_path: Path, run: Run, options: list[str], words: str
) -> None:
    log = write_log(tmp_path / "drive.lcm", drive(1.0))
    code, _, err = run(log, *options)
    assert code == 2
    assert words in " ".join(re.sub(r"[│╭╮╰╯─]", " ", err).split())


def test_given_a_report_over_what_is_read_or_written_then_it_is_rejected(tmp_path: Path, run: Run) -> None:
    log = write_log(tmp_path / "drive.lcm", drive(1.0))
    before = log.read_bytes()
    assert "is an input of this command" in run(log, "-c", HUSKY, "--report", log)[2]
    assert log.read_bytes() == before
    one = tmp_path / "one"
    assert "already the file of the poses" in run(log, "-c", HUSKY, "--poses", one, "--report", one)[2]
    assert not one.exists()


# --- drawing ------------------------------------------------------------------------------------------------


def read_figure(drawn: str) -> dict[str, Any]:
    """Return the figure of a chart."""
    figure: dict[str, Any] = json.loads(drawn.partition('json">')[2].partition("</script>")[0])
    return figure


def test_given_many_points_then_a_curve_keeps_its_peaks_and_little_else() -> None:
    points = np.array([(n / 100.0, 5.0 if n == 3333 else 0.0) for n in range(10_000)])
    drawn = charts.decimate(points, np.floor(points[:, 0])).tolist()
    assert len(drawn) <= 4 * 101
    assert [33.33, 5.0] in drawn


def test_given_a_curve_with_a_gap_then_the_gap_stays() -> None:
    t = np.arange(100_000) / 1000.0
    y = np.where((t > 40.0) & (t < 60.0), np.nan, np.sin(t))
    panel = charts.Panel("p", charts.Axis("m", -1.0, 1.0), [charts.Series("line", t, y)])
    (trace,) = read_figure(charts.render_panels("a", charts.Axis("s", 0.0, 100.0), [panel]))["data"]
    x, drawn = read_numbers(trace["x"]), read_numbers(trace["y"])
    assert len(x) <= 4 * charts.COLUMNS + 8
    assert np.isnan(drawn[(x > 40.1) & (x < 59.9)]).all()
    assert np.isfinite(drawn[(x < 39.9) | (x > 60.1)]).all()
    assert drawn[np.isfinite(drawn)] == pytest.approx(np.sin(x[np.isfinite(drawn)]), abs=1e-3)


@pytest.mark.parametrize(
    ("low", "high"), [(1.0e-5, 1.6e-5), (0.0012, 0.0014), (500000.001, 500000.004), (-0.00586, -0.00584)]
)
def test_given_small_changes_of_any_value_then_they_are_drawn_with_digits_for_each_tick(
    low: float, high: float
) -> None:
    t = np.arange(100.0)
    y = low + (high - low) * (0.5 + 0.5 * np.sin(t))
    axis = charts.Axis("m", *charts.value_range(y.tolist()))
    figure = read_figure(
        charts.render_panels("a", charts.Axis("s", 0.0, 100.0), [charts.Panel("p", axis, [charts.Series("y", t, y)])])
    )
    assert read_numbers(figure["data"][0]["y"]) == pytest.approx(y, abs=1e-3 * (high - low))
    form = figure["layout"]["yaxis"]
    # no prefix as in 16µ or 500.000001k
    assert form["exponentformat"] == ("power" if high < 1e-3 and low > -1e-3 else "none")
    assert form["range"] == pytest.approx((low, high), abs=0.2 * (high - low))


def test_given_a_constant_then_its_axis_has_a_range_that_doubles_resolve() -> None:
    assert charts.value_range([4693737.1] * 3) == pytest.approx((0.9 * 4693737.1, 1.1 * 4693737.1))
    assert charts.value_range([0.0, 0.0]) == (-0.5, 0.5)
    assert charts.value_range([2e-10, 4e-10]) == pytest.approx((1.9e-10, 4.1e-10))


def test_given_many_dots_then_a_cell_has_one_and_those_beyond_are_at_the_edge() -> None:
    axis = charts.Axis("m", -1.0, 1.0)
    many = charts.Series("dots", [n / 1000.0 for n in range(100_000)], [0.5] * 99_999 + [7.0], shape="dots")
    drawn = charts.render_panels("a", charts.Axis("s", 0.0, 100.0), [charts.Panel("p", axis, [many])])
    y = read_numbers(read_figure(drawn)["data"][0]["y"])
    assert len(y) <= charts.COLUMNS + 2
    assert y.max() == 1.0


def test_given_a_name_with_marks_of_html_then_it_is_written_as_text() -> None:
    row = charts.StripRow("<i>", [(0.0, 1.0, '"&<')], charts.RED)
    drawn = charts.render_strip('<b>"', charts.Axis("</script>", 0.0, 1.0), [row])
    assert drawn.count("</script>") == 1
    assert 'aria-label="&lt;b&gt;&quot;"' in drawn
    figure = read_figure(drawn)
    # the library knows some tags
    assert figure["data"][0]["y"] == ["&lt;i&gt;"]
    assert figure["layout"]["xaxis"]["title"]["text"] == "&lt;/script&gt;"


def test_given_no_plotly_then_the_error_has_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extras, "find_spec", lambda name: None if name == "plotly" else name)
    with pytest.raises(ModelServerError, match=re.escape(make_install_command("report"))):
        charts.render_page("a", "b")
