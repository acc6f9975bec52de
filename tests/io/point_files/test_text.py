"""Text as programs write it: read right, or refused with its head quoted."""

import numpy as np
import pytest

from dbdnet_jax.io.point_files import read_point_file
from tests.conftest import random_cloud

POINTS = random_cloud(1, 40).round(5)


def rows(form: str, points=POINTS) -> str:
    return "".join(form.format(i, *p) + "\n" for i, p in enumerate(points))


PLAIN = "{1:.5f} {2:.5f} {3:.5f}"
READ = {
    "cloudcompare.txt": "//X Y Z R G B\n" + rows(PLAIN + " 1 2 3"),
    "semicolons.csv": "X;Y;Z;R;G;B\n" + rows("{1:.5f};{2:.5f};{3:.5f};1;2;3"),
    "german.csv": "X;Y;Z\n" + rows("{1:.5f};{2:.5f};{3:.5f}").replace(".", ","),
    "blanks and commas.xyz": rows(PLAIN).replace(".", ","),
    "units.csv": "id;x;y;z\n-;m;m;m\n" + rows("{0};{1:.5f};{2:.5f};{3:.5f}"),
    "paraview.csv": '"I","Points:0","Points:1","Points:2"\n' + rows("7,{1:.5f},{2:.5f},{3:.5f}"),
    "survey.csv": "P,Northing,Easting,Elev\n" + rows("P{0},{2:.5f},{1:.5f},{3:.5f}"),
    "normals.csv": "nx,ny,nz,X(mm),Y(mm),Z(mm)\n" + rows("0,0,1,{1:.5f},{2:.5f},{3:.5f}"),
    "quoted.csv": '"a","x","y","z"\n' + rows('"b,c","{1:.5f}","{2:.5f}","{3:.5f}"'),
    "empty at the end.csv": "x,y,z,,\n" + rows("{1:.5f},{2:.5f},{3:.5f},,"),
    "tabs and blanks.asc": rows("{1:.5f}\t{2:.5f} {3:.5f}\t"),
    "fields.txt": "# FIELDS intensity x y z\n" + rows("9 " + PLAIN),
    "prose.txt": "# the fields x y z are in metres\n" + rows(PLAIN + " 7 8 9"),
    "fortran.txt": rows("{1:.5f}D+00 {2:.5f}D+00 {3:.5f}D+00"),
    "counted.pts": "40\n" + rows(PLAIN + " 5 1 2 3"),
    "pandas.csv": ",x,y,z\n" + rows("{0},{1:.5f},{2:.5f},{3:.5f}"),
    "windows.xyz": rows(PLAIN).replace("\n", "\r\n"),
    "dos.xyz": rows(PLAIN).replace("\n", "\r\n") + "\x1a",
    "mac.xyz": rows(PLAIN).replace("\n", "\r"),
    "blank.xyz": "\n  \n" + rows(PLAIN).replace("\n", "\n\n"),
    "remarks.txt": rows(PLAIN + "  # point {0}") + "# the end\n",
    "exponents.xyz": rows("{1:.8e} {2:+.8E} {3:.8e}"),
    "typeset.txt": rows(PLAIN).replace("-", "\u2212"),
    "excel.csv": "sep=;\nx;y;z\n" + rows("{1:.5f};{2:.5f};{3:.5f}").replace(".", ","),
    "sheets.csv": "x,y,z\n" + rows('"{1:.5f}","{2:.5f}","{3:.5f}"').replace(".", ","),
    "heights.csv": "P;X;Y;Altitude\n" + rows("P{0};{1:.5f};{2:.5f};{3:.5f}"),
    "metric heights.csv": "x_m,y_m,n,h\n" + rows("{1:.5f},{2:.5f},7,{3:.5f}"),
    "tecplot.txt": 'VARIABLES = "X", "Y", "Z"\nZONE I=40, F=POINT\n' + rows(PLAIN),
}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "utf-8-sig"])
@pytest.mark.parametrize("name", READ)
def test_it_is_read_right(tmp_path, name, encoding):
    (tmp_path / name).write_bytes(READ[name].encode(encoding))
    np.testing.assert_allclose(read_point_file(tmp_path / name).points, POINTS, atol=1e-12)


REFUSED = {
    "no names.csv": ("id,a,b,c\n" + rows("{0},{1:.5f},{2:.5f},{3:.5f}"), "named x, y, z: 'id,a"),
    "index.txt": (rows("{0} " + PLAIN), "first column counts the rows"),
    "two sets.csv": ("x_m,y_m,z_m,x_ft,y_ft,z_ft\n" + rows("1,2,3,4,5,6"), "several of its col"),
    "angles.csv": ("id,lat,lon,h\n" + rows("P,{1:.5f},{2:.5f},{3:.5f}"), "angles, not lengths"),
    "thousands.csv": (rows("1,234.5;2,345.6;{0},100.5"), "no line has three numbers"),
    "either.csv": (rows("1,500;2,25{0:02d};9,100").replace("2,25", "2,2"), "may be decimal"),
    "pairs.csv": (rows("{1:.5f},{2:.5f},{3:.5f}", abs(POINTS)).replace(".", ","), "between col"),
    "cut.pts": ("90\n" + rows(PLAIN), "promises 90 rows, and it holds 40"),
    "short.txt": (rows(PLAIN) + "1.5 2.5\n" + rows(PLAIN), "line 41 must have 3 columns"),
    "word.txt": (rows(PLAIN) + "1.5 2.5 x\n", "line 41|numbers"),
    "letter.xyz": ("O.5 1.5 2.5\n" + rows(PLAIN), "one but for a cell that is no number"),
    "worded.txt": ("x1.5 2.5 3.5 4\n" + rows(PLAIN + " 7"), "but for a cell that is no number"),
    "raster.asc": ("ncols 3\nnrows 40\ncellsize 1\n" + rows(PLAIN), "it is a raster of heights"),
    "raster.txt": ("DSAA\n3 40\n0 1\n0 1\n0 9\n" + rows(PLAIN), "it is a raster of heights"),
    "ply.txt": ("ply\nformat ascii 1.0\nend_header\n" + rows(PLAIN), "it is a PLY"),
    "ragged.txt": ("1.5 2.5 3.5 4 5\n" + rows(PLAIN + " 1 2 3 4"), "Begin it with # if it"),
    "two heights.csv": (
        "x,y,alt,height\n" + rows(PLAIN + " 7").replace(" ", ","),
        "several of its",
    ),
    "binary.txt": ("1 2 3\n\0\1\2\0\0\0\0\n", "no text"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_it_is_refused_and_said_why(tmp_path, name):
    text, message = REFUSED[name]
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=message):
        read_point_file(tmp_path / name)


def test_rows_of_nan_are_dropped_and_counted(tmp_path):
    text = "x,y,z\n" + rows("{1:.5f},{2:.5f},{3:.5f}") + "nan,nan,nan\n1.#QNAN,1,1\n,,5\n"
    (tmp_path / "a.csv").write_text(text.replace(",,5", ",1,5"))
    found = read_point_file(tmp_path / "a.csv")
    np.testing.assert_allclose(found.points, POINTS)
    assert found.notes == ("source (a.csv): 3 of 43 points have NaN or infinity and were left out",)


def test_too_few_rows_say_how_many_were_dropped(tmp_path):
    (tmp_path / "a.xyz").write_text(rows(PLAIN, POINTS[:15]) + "nan nan nan\n" * 5)
    with pytest.raises(ValueError, match=r"16 points; got 15. Give more points. \(5 of 20 points"):
        read_point_file(tmp_path / "a.xyz")


def test_a_ptx_scan_is_moved_by_its_pose_and_loses_what_was_not_seen(tmp_path):
    head = "42\n1\n5 6 7\n1 0 0\n0 1 0\n0 0 1\n0 1 0 0\n-1 0 0 0\n0 0 1 0\n5 6 7 1\n"
    text = head + rows(PLAIN + " 0.5") + "0 0 0 0.5\n" * 2
    (tmp_path / "a.ptx").write_text(text)
    found = read_point_file(tmp_path / "a.ptx")
    turn = np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    np.testing.assert_allclose(found.points, POINTS @ turn + [5, 6, 7], atol=1e-12)
    assert "2 rows at 0 0 0" in found.notes[0]
