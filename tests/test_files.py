"""Names of files that follow from labels, and numbers and truth values as files hold them."""

import json
import os

import numpy as np

from armperturb.files import endings_of, finite_or_none, write_csv, write_whole


def test_labels_give_names_of_files_that_are_never_alike():
    endings = endings_of(["PT7.5", "RT/7.5", "RT_7.5", "RT:7.5", "../up", "PT7.5"])
    assert endings == {
        "PT7.5": "PT7.5",
        "RT/7.5": "RT_7.5",
        "RT_7.5": "RT_7.5_2",
        "RT:7.5": "RT_7.5_3",
        "../up": ".._up",
    }


def test_truth_values_have_one_spelling_in_tables(tmp_path):
    write_csv([{"converged": True, "stable": np.False_, "n": 1}], tmp_path / "table.csv")
    assert (tmp_path / "table.csv").read_text() == "converged,stable,n\ntrue,false,1\n"


def test_numbers_that_json_cannot_hold_are_null():
    content = {"a": [1.5, float("nan"), {"b": np.inf}], "c": (2, "text", None)}
    assert (
        json.dumps(finite_or_none(content), allow_nan=False)
        == '{"a": [1.5, null, {"b": null}], "c": [2, "text", null]}'
    )


def test_names_of_files_that_are_no_text_are_written_as_escapes(tmp_path):
    write_whole(tmp_path / "page.html", os.fsdecode(b"<p>q-\xff.csv</p>"))
    assert (tmp_path / "page.html").read_text() == r"<p>q-\udcff.csv</p>"


def test_names_may_be_as_long_as_the_file_system_takes(tmp_path):
    write_whole(tmp_path / ("é" * 125 + ".csv"), "1\n")
    assert len(list(tmp_path.iterdir())) == 1
