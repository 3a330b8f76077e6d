"""The decoders that doc/wire-format.md gives to users, run against messages from our writer and from others."""

import re
import shutil
import struct
import subprocess
import sys
import sysconfig
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sensor_msgs
from adapters.clouds import STAMP, cloud, make_tracks, track_columns
from sensor_msgs.msg import PointCloud2

from msg_adapters import track_table
from msg_adapters.track_table import track_table_from_msg, track_table_to_msg

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "doc" / "wire-format.md").read_text(encoding="utf-8")


def snippet(kind: str) -> str:
    (code,) = re.findall(rf"<!-- decoder: {kind} -->\n```\w+\n(.*?)```", PAGE, re.DOTALL)
    return str(code)


@pytest.fixture(scope="module")
def decode() -> Callable[[PointCloud2], Any]:
    names: dict[str, Any] = {}
    exec(snippet("python"), names)
    return names["decode_track_table"]  # type: ignore[no-any-return]


def test_the_python_decoder_is_short() -> None:
    lines = snippet("python").split("def ", 1)[1].rstrip().splitlines()
    assert len(lines) <= 20


@pytest.mark.parametrize("components", [1, 3])
def test_the_python_decoder_reads_what_we_write(decode: Callable[[PointCloud2], Any], components: int) -> None:
    tracks = make_tracks(5, components, uuid=np.ones((5, 16), np.uint8), dof=np.full(5, 5.0))
    axes, got = decode(track_table_to_msg(tracks, tracks.axes, STAMP))
    assert tuple(axes) == tracks.axes
    assert [t[0] for t in got] == tracks.track_id.tolist()
    for k, (_, weight, mean, cov) in enumerate(got):
        np.testing.assert_array_equal(weight, tracks.weight[k])
        np.testing.assert_array_equal(mean, tracks.mean[k])
        np.testing.assert_allclose(cov, tracks.cov[k], rtol=1e-12)


@pytest.mark.parametrize("big_endian", [False, True])
def test_the_python_decoder_agrees_with_ours(decode: Callable[[PointCloud2], Any], big_endian: bool) -> None:
    msg = cloud(track_columns(), big_endian=big_endian, gap=1)
    ours, (_, got) = track_table_from_msg(msg), decode(msg)
    assert [t[0] for t in got] == ours.track_id.tolist()
    np.testing.assert_array_equal(got[1][3], ours.cov[1])


def test_the_python_decoder_takes_an_empty_scan(decode: Callable[[PointCloud2], Any]) -> None:
    axes, got = decode(track_table_to_msg(make_tracks(0), ("x", "y", "vx", "vy"), STAMP))
    assert (axes, got) == (["x", "y", "vx", "vy"], [])


HARNESS = """
#include <cstdio>
int main()
{
  sensor_msgs::msg::PointCloud2 msg;
  %s
  for (const auto & c : decode_track_table(msg)) {
    std::fwrite(&c.track_id, 4, 1, stdout);
    const double v[] = {c.weight, c.x, c.y, c.cov_x_x, c.cov_x_y, c.cov_y_y};
    std::fwrite(v, 8, 6, stdout);
  }
}
"""


def as_cpp(msg: PointCloud2) -> str:
    """Build the same message in C++."""
    lines = [f"msg.height = {msg.height}; msg.width = {msg.width}; msg.point_step = {msg.point_step};"]
    lines += [f"msg.row_step = {msg.row_step}; msg.data = {{{', '.join(map(str, msg.data))}}};"]
    for f in msg.fields:
        lines.append(f'{{sensor_msgs::msg::PointField f; f.name = "{f.name}"; f.offset = {f.offset};')
        lines.append(f"f.datatype = {f.datatype}; f.count = {f.count}; msg.fields.push_back(f);}}")
    return "\n  ".join(lines)


def include_folders() -> list[Path]:
    """Where the C++ headers are: beside a sourced ROS, or those which come with the wheels."""
    prefixes = {Path(sysconfig.get_path("data")), Path(sensor_msgs.__file__).parents[4]}
    return [folder for p in prefixes for folder in sorted((p / "include").glob("*")) if folder.is_dir()]


@pytest.mark.parametrize("count", [0, 3])
def test_the_cpp_decoder_compiles_and_reads_what_we_write(tmp_path: Path, count: int) -> None:
    compiler = shutil.which("g++")
    folders = include_folders()
    if compiler is None or not any((f / "sensor_msgs" / "point_cloud2_iterator.hpp").exists() for f in folders):
        pytest.skip("needs g++ and the headers of sensor_msgs")
    tracks = make_tracks(count, 2)
    msg = track_table_to_msg(tracks, tracks.axes, STAMP)
    (tmp_path / "main.cpp").write_text(snippet("cpp") + HARNESS % as_cpp(msg), encoding="utf-8")
    flags = ["-std=c++17", "-Wall", "-Wextra", "-Werror", *(f"-isystem{f}" for f in folders)]
    command = [compiler, *flags, str(tmp_path / "main.cpp"), "-o", str(tmp_path / "main")]
    built = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert built.returncode == 0, built.stderr[-3000:]
    out = subprocess.run([str(tmp_path / "main")], capture_output=True, check=True, timeout=20).stdout
    got = list(struct.iter_unpack("<I6d", out))
    want = [
        (i, w, m[0], m[1], c[0, 0], c[0, 1], c[1, 1])
        for i, weight, mean, cov in zip(tracks.track_id, tracks.weight, tracks.mean, tracks.cov, strict=True)
        for w, m, c in zip(weight, mean, cov, strict=True)
    ]
    assert got == want


def test_every_field_and_every_reason_is_on_the_page() -> None:
    tracks = make_tracks(1, uuid=np.zeros((1, 16), np.uint8), dof=np.full(1, 5.0), phd=True)
    for field in track_table_to_msg(tracks, tracks.axes, STAMP).fields[:8]:
        assert f"| `{field.name}` |" in PAGE
    folder = Path(track_table.__file__).parent
    sources = "".join(p.read_text(encoding="utf-8") for p in folder.glob("*.py"))
    reasons = set(re.findall(r'MessageError\(\s*"(\w+)"', sources))
    assert len(reasons) >= 9
    assert not {r for r in reasons if f"`{r}`" not in PAGE}


def test_the_adapters_import_neither_the_library_nor_rclpy() -> None:
    code = (
        "import sys, importlib, pathlib, msg_adapters\n"
        "for p in pathlib.Path(msg_adapters.__path__[0]).glob('*.py'):\n"
        "    importlib.import_module('msg_adapters.' + p.stem)\n"
        "print([m for m in sys.modules if m.split('.')[0] in ('track_fusion', 'rclpy', 'scipy')])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, timeout=60, check=True)
    assert out.stdout.strip() == "[]"
