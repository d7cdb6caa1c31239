"""Point files: what is read, and how every fault is named."""

from pathlib import Path

import numpy as np
import pytest

from docking.errors import BadPointFile, FileUnreadable
from docking.point_file import read_points, read_weights

HEAD = "name,x_mm,y_mm,z_mm\n"


def file(tmp_path: Path, text: str | bytes) -> Path:
    path = tmp_path / "points.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_plain_points(tmp_path: Path) -> None:
    p = read_points(file(tmp_path, "\ufeff" + HEAD + "\r\nA, 1,2.5,-3e2\r\n\r\nB,0.5,.5,5.\r\n,,,\r\n"), "nominal")
    assert p.names == ("A", "B")
    assert np.array_equal(p.xyz_mm, [[1, 2.5, -300], [0.5, 0.5, 5]])
    assert np.all(np.isnan(p.cov_mm2))


def test_sigmas_become_covariances(tmp_path: Path) -> None:
    p = read_points(file(tmp_path, "Name,X_mm,y_mm,z_mm,sx_mm,sy_mm,sz_mm\nA,1,2,3,0.1,0.2,0.3\n"), "measured")
    assert np.allclose(p.cov_mm2[0], np.diag([0.01, 0.04, 0.09]))


def test_passes_are_rows_of_one_name(tmp_path: Path) -> None:
    p = read_points(file(tmp_path, HEAD + "A,1,2,3\nB,1,2,3\nA,1,2,3\nA,1,2,3\n"), "measured")
    assert p.passes == (1, 1, 2, 3)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", "empty"),
        ("x,y,z\n1,2,3\n", "line 1"),
        ("name,x_mm,y_mm,z_mm,sx_mm\n", "missing: sy_mm, sz_mm"),
        ("name,x_mm,y_mm\nA,1,2\n", "missing: z_mm"),
        ("name;x_mm;y_mm;z_mm\nA;1,5;2;3\n", "semicolons separate"),
        ("name\tx_mm\ty_mm\tz_mm\n", "tabs separate"),
        ("x_mm,y_mm,z_mm,name\n", "not understood"),
        (HEAD + "A,1,2\n", "line 2: 3 fields"),
        (HEAD + "A,1,2,3,4\n", "line 2: 5 fields"),
        (HEAD + "A,1,2,3\n\nB,1,abc,3\n", "line 4, column y_mm: 'abc'"),
        (HEAD + "A,nan,2,3\n", "line 2, column x_mm: 'nan'"),
        (HEAD + "A,1,-inf,3\n", "line 2, column y_mm: '-inf'"),
        (HEAD + "A,1,2,1e400\n", "line 2, column z_mm: '1e400'. more than 1e+07 mm"),
        (HEAD + "A,5e9,2,1\n", "line 2, column x_mm: '5e9'. more than 1e+07 mm"),
        (HEAD + "A,1,2,1_000\n", "line 2, column z_mm: '1_000'"),
        (HEAD + "A,1,2,0x10\n", "line 2, column z_mm: '0x10'"),
        (HEAD + "A,1,2,\n", "line 2, column z_mm: ''"),
        (HEAD + ",1,2,3\n", "line 2, column name"),
        (HEAD + "A,1,2,3\nA,1,2,3\n", "line 3, column name: 'A'"),
        (HEAD + 'A,"1,2,3\n', "not CSV"),
        ("name,x_mm,y_mm,z_mm,sx_mm,sy_mm,sz_mm\nA,1,2,3,0.1,0,0.1\n", "line 2, column sy_mm: '0'"),
        ("name,x_mm,y_mm,z_mm,sx_mm,sy_mm,sz_mm\nA,1,2,3,0.1,0.1,-1\n", "line 2, column sz_mm: '-1'"),
    ],
)
def test_faults_name_line_column_and_value(tmp_path: Path, text: str, named: str) -> None:
    with pytest.raises(BadPointFile) as caught:
        read_points(file(tmp_path, text), "nominal")
    assert named in caught.value.text()
    assert "points.csv" in caught.value.text()
    assert caught.value.exit_code == 2


def test_unreadable_files(tmp_path: Path) -> None:
    for path in (tmp_path / "none.csv", tmp_path, file(tmp_path, b"name,x_mm,y_mm,z_mm\n\xff\xfe,1,2,3\n")):
        with pytest.raises(FileUnreadable):
            read_points(path, "nominal")


def test_too_many_points(tmp_path: Path) -> None:
    with pytest.raises(BadPointFile, match="2001 points"):
        read_points(file(tmp_path, HEAD + "".join(f"P{i},{i},0,0\n" for i in range(2001))), "measured")


def test_weights_are_read_where_they_are_used_and_refused_elsewhere(tmp_path: Path) -> None:
    path = file(tmp_path, "name,x_mm,y_mm,z_mm,weight\nA,1,2,3,4\nB,1,2,4,0.5\nA,1,2,3,4\n")
    assert read_weights(path) == {"A": 4.0, "B": 0.5}
    points = read_points(path, "measured", weighted=True)
    assert points.xyz_mm.shape == (3, 3)
    assert np.all(np.isnan(points.cov_mm2))
    with pytest.raises(BadPointFile):
        read_points(path, "measured")
    both = file(tmp_path, "name,x_mm,y_mm,z_mm,sx_mm,sy_mm,sz_mm,weight\nA,1,2,3,0.1,0.2,0.3,7\n")
    assert read_weights(both) == {"A": 7.0}
    assert np.allclose(np.diag(read_points(both, "measured", weighted=True).cov_mm2[0]), [0.01, 0.04, 0.09])
    for weight in ("0", "-1", "nan", ""):
        with pytest.raises(BadPointFile):
            read_weights(file(tmp_path, f"name,x_mm,y_mm,z_mm,weight\nA,1,2,3,{weight}\n"))
    assert read_weights(file(tmp_path, "name,x_mm,y_mm,z_mm\nA,1,2,3\n")) == {}
