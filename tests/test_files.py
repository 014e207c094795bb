"""Names of files that follow from labels."""

from armperturb.files import endings_of


def test_labels_give_names_of_files_that_are_never_alike():
    endings = endings_of(["PT7.5", "RT/7.5", "RT_7.5", "RT:7.5", "../up", "PT7.5"])
    assert endings == {
        "PT7.5": "PT7.5",
        "RT/7.5": "RT_7.5",
        "RT_7.5": "RT_7.5_2",
        "RT:7.5": "RT_7.5_3",
        "../up": ".._up",
    }
