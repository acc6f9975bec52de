"""What reaches the terminal: signs, and advice that can be followed there."""

import io

import pytest

from dbdnet_jax.io.terminal import for_command_line, printable, say


@pytest.mark.parametrize(
    "sign", "\x00\x07\x1b\x7f\x9b\n\r\t\u061c\u200e\u202e\u2066\u2028\udce9\ufeff"
)
def test_what_is_no_sign_is_escaped(sign):
    shown = printable(f"a{sign}b")
    assert shown[0] + shown[-1] == "ab" and "\\" in shown and shown.isprintable()


def test_letters_of_every_script_stay():
    assert printable("Größe 漢字 عربى 🦆 ~") == "Größe 漢字 عربى 🦆 ~"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a guess helps: `initial=`", "a guess helps: --initial"),
        ("only nearby; search='any' looks farther", "only nearby; --search any looks farther"),
        ("initial must be 4x4", "--initial must be 4x4"),
        ("max_points must be at least 64", "--max-points must be at least 64"),
        ("1 is NaN. Give points[np.isfinite(points).all(1)].", "1 is NaN. Mend the file."),
        ("got (3, 40). Rows are points: give points.T.", "got (3, 40). Mend the file."),
        ("the scale of a map", "the scale of a map"),
    ],
)
def test_advice_for_python_becomes_advice_for_the_command_line(text, expected):
    assert for_command_line(text) == expected


def test_a_stream_that_is_not_there_or_closed_gets_nothing(monkeypatch):
    out = io.StringIO()
    monkeypatch.setattr("sys.stdout", out)
    monkeypatch.setattr("sys.stderr", None)
    say("progress", to_stderr=True)
    assert out.getvalue() == ""
    out.close()
    say("answer")
