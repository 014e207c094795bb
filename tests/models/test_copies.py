"""Models that would become too large, or never end, are refused before MuJoCo reads them."""

import os

import pytest

from armperturb.models import copies
from armperturb.models.scene import load_arm

COPIED = '<mujoco><worldbody><replicate count="{}"><geom size="0.1"/>{}</replicate></worldbody></mujoco>'


@pytest.mark.parametrize(
    "text",
    [
        COPIED.format(10**8, ""),
        COPIED.format(1000, '<replicate count="1000"><geom size="0.1"/></replicate>'),
        COPIED.format(1000, '<include file="part.xml"/>'),
        '<mujoco><worldbody><body><composite type="particle" count="100 100 100"><geom/></composite></body></worldbody>'
        "</mujoco>",
    ],
)
def test_many_copies_are_refused(tmp_path, text):
    (tmp_path / "part.xml").write_text('<mujoco><replicate count="1000"><geom size="0.1"/></replicate></mujoco>')
    (tmp_path / "arm.xml").write_text(text)
    with pytest.raises(ValueError, match=r"arm\.xml: more than 200000 elements with all copies"):
        load_arm(tmp_path / "arm.xml")


def test_few_copies_are_made(tmp_path, monkeypatch):
    (tmp_path / "arm.xml").write_text(COPIED.format(10, ""))
    assert load_arm(tmp_path / "arm.xml").compile().ngeom == 10
    monkeypatch.setattr(copies, "MOST", 13)  # mujoco, worldbody, replicate and ten copies
    load_arm(tmp_path / "arm.xml")
    monkeypatch.setattr(copies, "MOST", 12)
    with pytest.raises(ValueError, match="more than 12 elements"):
        load_arm(tmp_path / "arm.xml")


def test_pipes_and_files_that_include_themselves_end(tmp_path):
    os.mkfifo(tmp_path / "pipe.xml")
    with pytest.raises(FileNotFoundError, match=r"pipe\.xml: is a folder, a pipe or a device; expected a file"):
        load_arm(tmp_path / "pipe.xml")
    (tmp_path / "itself.xml").write_text('<mujoco><include file="itself.xml"/></mujoco>')
    with pytest.raises(ValueError, match="already included"):
        load_arm(tmp_path / "itself.xml")
