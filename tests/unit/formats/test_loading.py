"""Loading a file: its format detected from the content, with limits, and nothing heavy imported."""

import os
import subprocess
import sys

import pytest
from support_formats import YAML, miro, miro_body, miro_constraint, miro_frame, rows, tree, tree_frame
from support_urdf import BOT_FRAMES, URDF

from modelserver.errors import GeometryError
from modelserver.formats import FORMATS, MAX_BYTES, check_file, format_of_path, load_model, save_model

TREE = tree(tree_frame("Rover"), tree_frame("Mast", "Rover"), tree_frame("Camera", "Mast"))


def only_error(path):
    with pytest.raises(GeometryError) as caught:
        load_model(path)
    (problem,) = caught.value.problems
    assert check_file(path) == (None, (problem,))
    assert problem.file == str(path)
    assert problem.fix
    return problem


@pytest.mark.parametrize(
    ("name", "text", "root"),
    [
        ("a.xml", miro(), "Cart"),
        ("a.xml", TREE, "Rover"),
        ("a.xml", "\ufeff" + miro(), "Cart"),
        ("a.yaml", YAML, "Cart"),
        ("a.yaml", miro(), "Cart"),
        ("a.txt", YAML, "Cart"),
        ("a.txt", "\ufeff" + YAML, "Cart"),
        ("a", "\n\n" + TREE, "Rover"),
        ("a", YAML.replace("\n", "\r\n"), "Cart"),
        ("a.xml", URDF, "cart"),
        ("a", URDF, "cart"),
        ("a.yaml", "# libbot2\n" + BOT_FRAMES, "local"),
        ("a.cfg", "other { x = 1; }\n" + BOT_FRAMES, "local"),
    ],
)
def test_the_format_is_detected_from_the_content_not_the_file_name(tmp_path, name, text, root):
    path = tmp_path / name
    path.write_bytes(text.encode())
    assert load_model(path).root.name == root


def test_a_file_of_50_megabytes_is_rejected_unread_and_the_limit_is_named(tmp_path):
    path = tmp_path / "huge.xml"
    path.touch()
    os.truncate(path, 50 * 1024**2)
    problem = only_error(path)
    assert "50 MiB" in problem.message
    assert f"limit is {MAX_BYTES // 1024**2} MiB" in problem.message


def test_a_device_and_a_fifo_are_rejected_at_once(tmp_path):
    assert "character device" in only_error("/dev/zero").message
    os.mkfifo(tmp_path / "fifo.yaml")
    # a FIFO without a writer: opening it would wait for one
    assert "FIFO" in only_error(tmp_path / "fifo.yaml").message


def test_a_directory_and_an_empty_file_are_problems(tmp_path):
    assert "directory" in only_error(tmp_path).message
    empty = tmp_path / "empty.yaml"
    empty.touch()
    assert "empty" in only_error(empty).message


def test_a_missing_file_is_an_oserror(tmp_path):
    with pytest.raises(FileNotFoundError):
        load_model(tmp_path / "none.yaml")


def test_a_symbolic_link_is_followed_and_a_cycle_of_them_is_an_oserror(tmp_path):
    (tmp_path / "real.yaml").write_text(YAML)
    (tmp_path / "link.yaml").symlink_to("real.yaml")
    assert load_model(tmp_path / "link.yaml").root.name == "Cart"
    (tmp_path / "loop.yaml").symlink_to("loop.yaml")
    with pytest.raises(OSError, match="symbolic links"):
        load_model(tmp_path / "loop.yaml")


def test_the_form_to_write_follows_from_the_ending():
    assert [format_of_path(name) for name in ("a.yaml", "a.YML", "b/a.xml", "a.urdf")] == [
        "yaml",
        "yaml",
        "miro",
        "urdf",
    ]
    for name in ("a.json", "a"):
        with pytest.raises(ValueError, match=r"\.yaml"):
            format_of_path(name)


def test_an_unknown_form_is_rejected_with_those_known(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text(YAML)
    with pytest.raises(ValueError, match=", ".join(FORMATS)):
        save_model(load_model(path), "sdf")


@pytest.mark.slow
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


def big_yaml():
    lines = ["bodies:"]
    for body in range(1000):
        lines += [f"  B{body}:", "    frames:"]
        lines += [
            f"      F{frame}: {{xyz: [{frame}.125, 0.5, -3], rpy_deg: [{body % 360}, 3, 5]}}" for frame in range(10)
        ]
    lines.append("constraints:")
    lines += [f"  C{n}: {{from: B{(n - 1) // 5}:F{1 + (n - 1) % 5}, to: B{n}:F0}}" for n in range(1, 1000)]
    return "\n".join(lines)


def big_miro():
    frames = [miro_frame(f"F{n}", rows(("0.978 0 0.208 1", "0 1 0 2", f"-0.208 0 0.978 {n}"))) for n in range(10)]
    ends = [(f"B{(n - 1) // 5}:F{1 + (n - 1) % 5}", f"B{n}:F0") for n in range(1, 1000)]
    return miro(
        [miro_body(f"B{n}", *frames) for n in range(1000)],
        [miro_constraint(f"C{n}", *each) for n, each in enumerate(ends)],
    )


def big_urdf():
    links = [f'<link name="L{n}"/>' for n in range(5000)]
    joints = [
        f'<joint name="J{n}" type="continuous"><origin xyz="0 {n} 1"/>'
        f'<parent link="L{(n - 1) // 5}"/><child link="L{n}"/></joint>'
        for n in range(1, 5001)
    ]
    return f'<robot name="big">{"".join(links)}<link name="L5000"/>{"".join(joints)}</robot>'


@pytest.mark.slow
@pytest.mark.parametrize("text", [big_yaml, big_miro, big_urdf])
def test_ten_thousand_frames_load(tmp_path, text):
    path = tmp_path / "big"
    path.write_text(text())
    model = load_model(path)
    assert sum(len(body.frames) for body in model.bodies) in (10_000, 10_001)
    assert len(model.assemblies) == 1
