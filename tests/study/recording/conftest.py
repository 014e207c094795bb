"""A study whose trials take a second."""

import shutil

import pytest


@pytest.fixture(scope="module")
def protocol(tmp_path_factory):
    from tests.recorded import PROTOCOL

    path = tmp_path_factory.mktemp("protocol") / "short.toml"
    path.write_text(PROTOCOL)
    return path


@pytest.fixture(scope="module")
def settings(protocol):
    from armperturb.study.recording.settings import StudySettings
    from tests.recorded import N_SUBJECTS

    return StudySettings(subjects=N_SUBJECTS, seed=3, protocol=protocol, muscles="linear")


@pytest.fixture(scope="module")
def finished(settings, once):
    """Folder of a study that nothing disturbed."""
    from armperturb.study.recording.record import record_study

    def make(folder):
        record_study(settings, folder, show_progress=False)
        return folder

    return once("finished", make)


@pytest.fixture(scope="module")
def undisturbed(finished):
    """File name to bytes of its recordings."""
    from tests.recorded import files

    return files(finished)


@pytest.fixture
def copied(finished, tmp_path):
    """Folder of the same study, to do something to."""
    shutil.copytree(finished, tmp_path / "copied")
    return tmp_path / "copied"
