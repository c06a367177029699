"""Actions of Human3.6M: spellings of public archives, the groups of HiT-DVAE's table 4, and their classifier."""

from dataclasses import replace

import numpy as np
import pytest

import dvae
from dvae import motion
from dvae.cli import main
from dvae.motion.data.actions import GROUPS, human36m_label
from dvae.motion.metric_models.action_classifier import ActionClassifier

NAMES = {
    "S1": ["Walking 1", "Greeting", "TakingPhoto", "WalkingDog 1", "SittingDown 2", "WalkingTogether"],
    "S9": ["Walking", "Greeting 1", "Photo", "WalkDog 1", "Sitting 1", "WalkTogether"],
}
SHORT = replace(motion.PROTOCOLS["h36m"], observed=4, predicted=6, validation=0.0)


def people(names=NAMES, labels=None):
    """Return random poses of Human3.6M's 17 joints, with clips of these names by subject."""
    rng = np.random.default_rng(0)
    poses = np.float32(0.4 * rng.random((12, 17, 3)))
    clips = [
        motion.Clip(subject, name, poses + np.float32(0.01 * rng.random((12, 17, 3))), (labels or {}).get(name, {}))
        for subject, of_subject in names.items()
        for name in of_subject
    ]
    return motion.MotionSet(clips, motion.HUMAN36M, "people")


def label(name, kind="action"):
    return human36m_label(motion.Clip("S1", name, np.zeros((1, 17, 3))), kind)


@pytest.mark.parametrize(
    ("names", "action", "group"),
    [
        (("Photo", "TakingPhoto", "Photo 1", "takingphoto_2", "TakingPhoto.54138969"), "Photo", "0"),
        (("WalkDog", "WalkingDog", "WalkDog 1", "walkingdog_1"), "WalkDog", "0"),
        (("WalkTogether", "WalkingTogether", "WalkTogether 1", "walkingtogether_2"), "WalkTogether", "4"),
        (("Walking", "Walking 1", "walking_2", "Walking 1.60457274"), "Walking", "3"),
        (("SittingDown", "SittingDown 2", "sittingdown_1"), "SittingDown", "2"),
        (("Sitting", "Sitting 1"), "Sitting", "1"),
    ],
)
def test_spellings_of_public_archives_are_one_action(names, action, group):
    assert {(label(name), label(name, "group")) for name in names} == {(action, group)}


def test_the_groups_divide_the_fifteen_actions():
    actions = [action for group in GROUPS.values() for action in group]
    assert len(actions) == len({*actions}) == 15
    assert [len(group) for group in GROUPS.values()] == [8, 4, 1, 1, 1]
    assert [label(action) for action in actions] == actions


@pytest.mark.parametrize("name", ["Jumping 1", "_ALL", "Walking 1 2", "WalkingFast", ""])
def test_an_unknown_action_is_an_error_that_names_it(name):
    with pytest.raises(ValueError, match=f"S1/{name} has no label 'group', and its name '{name}' is not an action"):
        label(name, "group")


def test_windows_have_the_labels_without_a_file():
    test = motion.windows(people(), SHORT, "test")
    assert test.label_names == ["action", "group"]
    assert {key[1]: group for key, group in zip(test.keys, test.labels("group"), strict=True)} == {
        "Walking": "3",
        "Greeting 1": "0",
        "Photo": "0",
        "WalkDog 1": "0",
        "Sitting 1": "1",
        "WalkTogether": "4",
    }
    assert ActionClassifier("group").resolve_defaults(motion.windows(people(), SHORT, "train")).classes == (
        *("0", "2", "3", "4"),
    )
    with pytest.raises(KeyError, match="labels are action, group"):
        test.labels("content")


def test_labels_of_the_file_take_precedence():
    train = motion.windows(people(labels={"Greeting": {"group": "polite"}}), SHORT, "train")
    assert set(train.labels("group")) == {"", "polite"}
    assert "Greeting" in train.labels("action")


def test_an_unknown_action_stops_training_but_no_other_use():
    train = motion.windows(people({"S1": ["Walking", "Jumping 1"], "S9": ["Walking"]}), SHORT, "train")
    with pytest.raises(ValueError, match="'Jumping 1' is not an action"):
        ActionClassifier("group").build(train)
    assert len(train)


def test_the_classifier_of_the_groups_scores_forecasts_on_the_command_line(tmp_path, capsys):
    """The archive has the layout of VideoPose3D's, with the 32 joints of the original recordings."""
    archive, rng = {}, np.random.default_rng(0)
    for subject, names in NAMES.items():
        poses = {name: 0.4 * rng.random((1, 32, 3)) + 0.01 * rng.random((130, 32, 3)) for name in names}
        archive[subject] = {name: np.float32(frames) for name, frames in poses.items()}
    path = tmp_path / "data_3d_h36m.npz"
    np.savez_compressed(path, positions_3d=np.array(archive, dtype=object))
    shared = ["--data", str(path), "--protocol", "h36m", "--steps", "2", "--batch-size", "2", "--validate-every", "2"]
    groups, run = tmp_path / "groups", tmp_path / "run"
    fit = ["action-classifier", "--label", "group", "--hidden", "4", "--features", "2"]
    assert main(["fit", *fit, *shared, "--out", str(groups)]) == 0
    assert dvae.load(groups).model.classes == ("0", "2", "3", "4")
    assert main(["fit", "bom", *shared, "--samples", "2", "--width", "4", "--out", str(run)]) == 0
    capsys.readouterr()
    assert main(["evaluate", str(run), "--classifier", str(groups), "--samples", "2"]) == 0
    printed = capsys.readouterr().out
    assert "ACC group" in printed
    assert "FID group" in printed
