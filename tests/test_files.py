"""Names of files that follow from labels, and numbers and truth values as files hold them."""

import json

import numpy as np

from armperturb.files import endings_of, finite_or_none, write_csv


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
