"""Printed sizes, read back from the files that go to the printer."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cv2", reason="the extra guidance is not installed")

from docking.errors import BadArgument
from docking.guidance.marker_sheet import MarkerDrawing, read_ids, write_sheets
from docking.guidance.opencv import opencv

MM_PER_PT = 25.4 / 72.0


def test_the_svg_holds_true_sizes_ids_and_a_bar(tmp_path: Path) -> None:
    files = write_sheets(tmp_path / "m.svg", (4, 17, 30), MarkerDrawing())
    assert [file.name for file in files] == ["m.svg", "m-2.svg"]
    root = ET.fromstring(files[0].read_text())
    assert (root.get("width"), root.get("height"), root.get("viewBox")) == ("210mm", "297mm", "0 0 210 297")
    discs = np.array([[float(c.get(key, "nan")) for key in ("cx", "cy", "r")] for c in root.findall("{*}circle")])
    assert len(discs) == 8
    assert np.allclose(discs[:, 2], 9.0)
    assert np.allclose(np.linalg.norm(np.diff(discs[:4, :2], axis=0), axis=1), 84.0, atol=1e-3)
    squares = [r for r in root.findall("{*}rect") if r.get("fill") == "black" and r.get("width") == "50"]
    assert len(squares) == 2
    text = " ".join(t.text or "" for t in root.findall("{*}text"))
    assert "id 4 " in text
    assert "id 17 " in text
    assert "100 mm" in text
    assert [r for r in root.findall("{*}rect") if r.get("width") == "100"]


def test_the_pdf_draws_the_same_lengths_in_points(tmp_path: Path) -> None:
    (file,) = write_sheets(tmp_path / "m.pdf", (4,), MarkerDrawing())
    data = file.read_bytes().decode("latin-1")
    assert "/PrintScaling /None" in data
    box = [float(v) for v in re.search(r"MediaBox \[([^]]*)\]", data)[1].split()]  # type: ignore[index]
    assert np.allclose(np.array(box[2:]) * MM_PER_PT, (210.0, 297.0), atol=1e-3)
    scale = float(re.search(r"([\d.]+) 0 0 ([\d.]+) 0 0 cm", data)[1])  # type: ignore[index]
    assert scale * MM_PER_PT == pytest.approx(1.0, abs=1e-9)
    lengths = [float(w) for w in re.findall(r"0 g [\d.]+ [\d.]+ ([\d.]+) [\d.]+ re f", data)]
    assert 50.0 in lengths
    assert 100.0 in lengths
    # The cross-reference table points at the objects: a reader opens it without repair.
    for number, offset in enumerate(re.findall(r"(\d{10}) 00000 n", data), 1):
        assert data[int(offset) :].startswith(f"{number} 0 obj")


def test_what_is_drawn_is_the_marker_of_that_id(tmp_path: Path) -> None:
    (file,) = write_sheets(tmp_path / "m.svg", (23,), MarkerDrawing())
    image = np.full((1188, 840), 255, np.uint8)
    for shape in ET.fromstring(file.read_text()):
        value = 0 if shape.get("fill") == "black" else 255
        if shape.tag.endswith("rect") and shape.get("x"):
            x, y, w, h = (4.0 * float(shape.get(key, "0")) for key in ("x", "y", "width", "height"))
            image[round(y) : round(y + h), round(x) : round(x + w)] = value
    cv2 = opencv()
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
    corners, ids, _ = detector.detectMarkers(image)
    assert ids.ravel().tolist() == [23]
    # OpenCV's first corner is the top-left of the upright marker: the sheet is not turned.
    assert np.argmin(corners[0].reshape(4, 2).sum(axis=1)) == 0


@pytest.mark.parametrize("text", ["", "3-1", "a", "1,1", "-2", "0-99999"])
def test_a_list_of_ids_that_makes_no_sense_is_refused(text: str) -> None:
    with pytest.raises(BadArgument):
        read_ids(text)


@pytest.mark.parametrize(
    ("drawing", "page"),
    [
        (MarkerDrawing("DICT_9X9_50"), "A4"),
        (MarkerDrawing(side_mm=float("nan")), "A4"),
        (MarkerDrawing(offset_mm=30.0), "A4"),
        (MarkerDrawing(side_mm=400.0, offset_mm=400.0), "A3"),
    ],
)
def test_a_marker_that_cannot_work_is_refused(tmp_path: Path, drawing: MarkerDrawing, page: str) -> None:
    with pytest.raises(BadArgument):
        write_sheets(tmp_path / "m.pdf", (1,), drawing, page)


def test_an_id_outside_the_dictionary_and_another_file_type_are_refused(tmp_path: Path) -> None:
    assert read_ids("0-2, 7") == (0, 1, 2, 7)
    with pytest.raises(BadArgument, match="0 to 49"):
        write_sheets(tmp_path / "m.pdf", (50,), MarkerDrawing())
    with pytest.raises(BadArgument):
        write_sheets(tmp_path / "m.png", (1,), MarkerDrawing())
