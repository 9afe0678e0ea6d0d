"""Loading a file: told by content, with limits, and nothing heavy imported."""

import os
import subprocess
import sys
import time

import pytest
from support_formats import YAML, miro, tree, tree_frame

from modelserver.errors import GeometryError
from modelserver.formats import FORMS, check_file, form_of_path, load_model, save_model
from modelserver.formats.content import MAX_BYTES

TREE = tree(tree_frame("Rover"), tree_frame("Mast", "Rover"), tree_frame("Camera", "Mast"))


def only_error(path):
    with pytest.raises(GeometryError) as caught:
        load_model(path)
    (problem,) = caught.value.problems
    assert check_file(path) == (None, (problem,))
    assert problem.file == str(path)
    assert problem.fix
    return problem


@pytest.mark.parametrize("ending", [".xml", ".yaml", ".txt", ""])
@pytest.mark.parametrize(
    ("text", "root"), [(YAML, "Cart"), (miro(), "Cart"), (TREE, "Rover"), ("\ufeff\n" + TREE, "Rover")]
)
def test_the_form_is_told_by_content_not_by_the_name_of_the_file(tmp_path, text, root, ending):
    if text is YAML and ending == ".xml":
        pytest.skip("a file named .xml that does not begin as XML is told so")
    path = tmp_path / f"vehicle{ending}"
    path.write_text(text.lstrip("\ufeff\n") if "\ufeff" not in text else text.replace("\n", "", 1), encoding="utf-8")
    assert load_model(path).root.name == root


def test_a_file_of_50_megabytes_is_refused_unread_and_the_limit_is_named(tmp_path):
    path = tmp_path / "huge.xml"
    path.touch()
    os.truncate(path, 50 * 1024**2)
    start = time.process_time()
    problem = only_error(path)
    assert time.process_time() - start < 0.1
    assert "50.0 MiB" in problem.message
    assert f"limit is {MAX_BYTES // 1024**2} MiB" in problem.message


def test_a_stream_without_end_is_refused_at_the_limit():
    assert "too large" in only_error("/dev/zero").message


def test_a_directory_and_an_empty_file_are_problems(tmp_path):
    assert "directory" in only_error(tmp_path).message
    empty = tmp_path / "empty.yaml"
    empty.touch()
    assert "empty" in only_error(empty).message


def test_a_missing_file_is_an_oserror(tmp_path):
    with pytest.raises(FileNotFoundError):
        load_model(tmp_path / "none.yaml")


def test_a_pipe_can_be_read():
    reading, writing = os.pipe()
    os.write(writing, YAML.encode())
    os.close(writing)
    try:
        assert load_model(f"/dev/fd/{reading}").root.name == "Cart"
    finally:
        os.close(reading)


def test_the_form_to_write_follows_from_the_ending():
    assert [form_of_path(name) for name in ("a.yaml", "a.YML", "b/a.xml")] == ["yaml", "yaml", "miro"]
    for name in ("a.json", "a"):
        with pytest.raises(ValueError, match=r"\.yaml"):
            form_of_path(name)


def test_an_unknown_form_is_refused_with_those_known(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text(YAML)
    with pytest.raises(ValueError, match=", ".join(FORMS)):
        save_model(load_model(path), "urdf")


@pytest.mark.parametrize(("text", "spared"), [(YAML, "lxml"), (miro(), "yaml")])
def test_nothing_heavy_is_imported(tmp_path, text, spared):
    path = tmp_path / "vehicle"
    path.write_text(text)
    script = (
        "import sys; from modelserver.formats import load_model; "
        "assert not {'lxml', 'yaml'} & set(sys.modules); load_model(sys.argv[1]); print(*sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", script, str(path)], capture_output=True, text=True, check=True)
    heavy = {"filterpy", "matplotlib", "scipy", "pyproj", "pydantic", "lcm", spared}
    assert heavy.isdisjoint(done.stdout.split())


def test_ten_thousand_frames_load_in_under_three_seconds(tmp_path):
    lines = ["bodies:"]
    for body in range(1000):
        lines += [f"  B{body}:", "    frames:"]
        lines += [
            f"      F{frame}: {{xyz: [{frame}.125, 0.5, -3], rpy_deg: [{body % 360}, 3, 5]}}" for frame in range(10)
        ]
    lines.append("constraints:")
    lines += [f"  C{n}: {{from: B{(n - 1) // 5}:F{1 + (n - 1) % 5}, to: B{n}:F0}}" for n in range(1, 1000)]
    path = tmp_path / "big.yaml"
    path.write_text("\n".join(lines))
    model = _timed(path)
    path.write_text(save_model(model, "miro").text)
    assert (
        _timed(path)
        .get_transformation("B999:F9", "B0:F0")
        .pose.is_close(model.get_transformation("B999:F9", "B0:F0").pose, 1e-9, 1e-9)
    )
    path.write_text(save_model(model, "miro-frames").text)
    assert _timed(path).get_transformation("B999:B999.F9", "B0:Origin")


def _timed(path):
    start = time.process_time()
    model = load_model(path)
    assert time.process_time() - start < 3
    assert sum(len(body.frames) for body in model.bodies) >= 10_000
    return model
