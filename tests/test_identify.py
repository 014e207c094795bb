"""From simulated recordings back to the people in them."""

import numpy as np
import pytest
import xarray as xr

from armperturb.analysis.identify import body_of, fit_environment, identify, variance_accounted_for
from armperturb.analysis.spectra import line_spectra
from armperturb.analysis.structures import STRUCTURES
from armperturb.environment import Environment
from armperturb.study.tables import true_value
from armperturb.subject import POSITION, RELAX


@pytest.mark.parametrize(("model", "arm"), [("1", RELAX), ("3b", POSITION)], ids=["1", "3b"])
def test_parameters_that_were_put_in_come_out(model, arm, request):
    recording = request.getfixturevalue("relax_recording" if model == "1" else "position_recording")
    # Every line is kept: averages over clusters are off by a few percent even without noise.
    result = identify(recording, model, lines_per_average=1)
    for name, estimate in result.fit.values.items():
        truth = true_value(arm, name)
        # kp_s is the direction that these data say least about: it may be off by what 5 Nm/rad are of it.
        assert estimate == pytest.approx(truth, rel=0.03, abs=5.0 if name.startswith("kp") else 0.0), name
    assert result.fit.stable
    assert result.fit.converged
    assert (result.vaf > 99.0).all()
    assert result.environment.m_env == pytest.approx(Environment().m_env, rel=0.01)
    assert result.environment.k_env == pytest.approx(Environment().k_env, rel=0.01)


def test_one_trial_is_enough_with_averages_over_clusters(position_recording):
    result = identify(position_recording.isel(trial=[2]), "3b")
    assert len(result.spectra.frequency) == 18
    assert (result.vaf > 98.0).all()
    for name in ("m_tot", "k_s", "k_e", "b_e"):
        assert result.fit.values[name] == pytest.approx(true_value(POSITION, name), rel=0.15)


def test_wrong_sign_of_the_force_is_named(position_recording):
    flipped = position_recording.assign(force=-position_recording["force"])
    with pytest.raises(ValueError, match="force must be the reaction force that the handle exerts on the hand"):
        identify(flipped, "3b")


def test_environment_is_exact_without_noise(relax_recording):
    for n_trials in (1, 4):
        found = fit_environment(line_spectra(relax_recording.isel(trial=slice(n_trials))))
        assert found.m_env == pytest.approx(Environment().m_env, rel=1e-3)
        assert found.b_env == pytest.approx(Environment().b_env, rel=1e-2)
        assert found.k_env == pytest.approx(Environment().k_env, rel=1e-2)


def test_vaf_follows_its_definition():
    time = np.arange(4000) / 200
    x = np.stack([np.sin(2 * np.pi * 2 * time), np.cos(2 * np.pi * 3 * time)], axis=-1)
    np.testing.assert_allclose(variance_accounted_for(x, x, 200), 100)
    np.testing.assert_allclose(variance_accounted_for(x, 0 * x, 200, highpass=None), 0)
    np.testing.assert_allclose(variance_accounted_for(x, 0.5 * x, 200, highpass=None), 75)
    np.testing.assert_allclose(variance_accounted_for(x, -x, 200, highpass=None), -300)


def test_vaf_forgets_slow_corrections():
    time = np.arange(6000) / 200
    x = np.stack([np.sin(2 * np.pi * 3 * time)] * 2, axis=-1)
    slow = 2 * np.sin(2 * np.pi * 0.03 * time)[:, None]
    assert (variance_accounted_for(x + slow, x, 200, highpass=None) < 50).all()
    assert (variance_accounted_for(x + slow, x, 200) > 99).all()


def test_body_is_read_from_the_recording(relax_recording):
    body = body_of(relax_recording)
    assert (body.task, body.l_h, body.l_f, body.name) == ("RT", RELAX.l_h, RELAX.l_f, "relax")
    np.testing.assert_allclose(body.posture, RELAX.posture)


def test_mixed_recordings_are_refused(relax_recording, position_recording):
    both = xr.concat([relax_recording, position_recording], "trial", combine_attrs="override")
    with pytest.raises(ValueError, match=r"several values of subject \(relax, position\); expected one"):
        identify(both, "1")


def test_unknown_models_are_named(relax_recording):
    with pytest.raises(ValueError, match="model = '9'; expected one of 1, 2, 3"):
        identify(relax_recording, "9")


def test_model_3b_fixes_the_published_grip_of_the_task():
    assert STRUCTURES["3b"].fixed["PT"]["k_h"] == 22.4e3
    assert STRUCTURES["3b"].fixed["RT"]["k_h"] == 8.4e3
