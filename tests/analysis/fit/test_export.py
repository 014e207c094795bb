"""Files of an identification: the fitted arm is one that can be simulated, where there is such a one."""

from dataclasses import replace

import numpy as np
import pytest

from armperturb.analysis.arm.geometry import mass_matrix
from armperturb.analysis.fit.export import write_arm
from armperturb.subject import POSITION, Subject

BARE = replace(POSITION, m_h=0.0, m_f=0.0, i_s=0.34, i_se=0.062, i_e=0.05)


def test_joint_inertia_is_written_as_that_of_rigid_segments(tmp_path):
    assert write_arm(BARE, tmp_path / "arm.toml") == ""
    written = Subject.load(tmp_path / "arm.toml")
    written.require_simulable()
    np.testing.assert_allclose(mass_matrix(written), mass_matrix(BARE), rtol=1e-12)
    of_body = {name: getattr(BARE, name) for name in ("m_h", "m_f", "c_f", "r_f", "i_s", "i_se", "i_e")}
    assert replace(written, **of_body) == BARE


@pytest.mark.parametrize(
    ("arm", "reason"),
    [
        (replace(BARE, i_e=0.1), "expected one that rigid segments can have"),
        (replace(POSITION, k_h=np.inf), "k_h = inf; expected a finite grip stiffness"),
    ],
)
def test_an_arm_that_no_simulation_has_is_written_as_it_is_and_said(tmp_path, arm, reason):
    assert reason in write_arm(arm, tmp_path / "arm.toml")
    assert Subject.load(tmp_path / "arm.toml") == arm
