"""Datasets of segments in runs: splits by take, and equal segments when a run is reopened."""

import json
from dataclasses import replace

import pytest
import torch

from dvae import motion
from dvae.motion.segments.dataset import SegmentData, SegmentSource
from dvae.motion.segments.embodied import SegmentSchema

PEOPLE = motion.simulate(clips=8, frames=80, seed=1)


@pytest.fixture(scope="module")
def data():
    return SegmentData("simulated", PEOPLE)


@pytest.fixture(scope="module")
def written(data):
    """Return the schema of warped segments as a run writes it."""
    return json.dumps(replace(data, warped=True).schema.config())


def test_splits_partition_the_takes_and_segments_have_names(data):
    windows = {split: data.windows(split) for split in ("train", "validation", "test")}
    sources = {split: {clip.labels["source"] for clip in each.motion} for split, each in windows.items()}
    assert all(sources.values())
    assert sum(map(len, sources.values())) == len(set.union(*sources.values()))
    assert sources["test"] == {clip.labels["source"] for clip in data.segments if clip.split == "test"}
    assert sum(map(len, windows.values())) == len(data.segments)
    first = data.segments.clips[0]
    for name in (first.name, f"{first.split}/{first.name}", first.labels["source"]):
        assert data.segments_of(name).motion.clips[0].key == first.key
    with pytest.raises(
        ValueError, match=r"no segment or take 'person_00' .did you mean 'person_00.*the first segment is train"
    ):
        data.segments_of("person_00")
    with pytest.raises(ValueError, match="no split 'all': expected train, validation or test"):
        data.windows("all")


@pytest.mark.parametrize("options", [{}, {"scaling": "deviation", "warped": True}], ids=["plain", "warped"])
def test_reopened_data_have_the_same_segments(options, tmp_path):
    motion.save(tmp_path / "people.npz", PEOPLE)
    data = SegmentData.open(tmp_path / "people.npz", **options)
    source, schema = data.recorded(), SegmentSchema.from_config(json.loads(json.dumps(data.schema.config())))
    again = SegmentData.reopen(SegmentSource(**vars(source)), schema)
    assert again.fingerprint == source.fingerprint
    assert (bool(schema.timed.mean), len(schema.timed.references)) == ((True, 2) if options else (False, 0))
    assert torch.equal(again.windows("test").all()["x"], data.windows("test").all()["x"])
    other = SegmentData.reopen(source, schema, "simulated")  # with the time grid of the run
    assert other.timed is schema.timed
    assert other.fingerprint != source.fingerprint


def test_training_segments_are_retargeted_to_random_bodies(data):
    train, validation, without_bodies = (
        data.windows("train"),
        data.windows("validation"),
        replace(data, bodies=0.0).windows("train"),
    )
    sampled, again, original = (
        each.sample(len(train), torch.Generator().manual_seed(3)) for each in (train, train, without_bodies)
    )
    assert torch.equal(sampled["x"], again["x"])
    for batch in (validation.sample(1, torch.Generator())["beta"], original["beta"][:1]):
        assert any(torch.equal(batch[0], beta) for each in (validation, without_bodies) for beta in each.all()["beta"])
    assert 0.8 < sampled["beta"].std() < 1.2
    rotation_columns = train.timed.parts["rotations"]
    order = torch.cdist(
        sampled["x"][..., rotation_columns].flatten(1), train.all()["x"][..., rotation_columns].flatten(1)
    ).argmin(1)
    assert order.sort().values.equal(torch.arange(len(train)))
    reordered = replace(train.motion, clips=[train.motion.clips[n] for n in order])
    retargeted = motion.bodies.retarget(reordered, motion.bodies.human(), sampled["beta"].double())
    for value, expected in zip(*map(_heading_free, (sampled["x"], train.timed.to(retargeted)["x"])), strict=True):
        torch.testing.assert_close(value, expected, atol=1e-5, rtol=0)


def _heading_free(x):
    """Return joint rotations without the root, distance, time, and the heading as seen in joint positions."""
    return x[..., 6:-4], x[..., -4:-1:2].norm(dim=-1), x[..., -3], x[..., -1]


def test_clips_as_long_as_a_segment_are_segments():
    clips = [replace(clip, positions=clip.positions[: 5 + 12 * n]) for n, clip in enumerate(PEOPLE)]
    data = SegmentData("simulated", replace(PEOPLE, clips=clips), "clips")
    assert [clip.frames for clip in data.segments] == [clip.frames for clip in clips if clip.frames > 9]
    assert data.fingerprint != replace(data, cut="gait").fingerprint
    with pytest.raises(ValueError, match=r"uses clips of 0\.3 to 3 s.*cut='gait' finds the gait cycles"):
        assert SegmentData("simulated", replace(PEOPLE, clips=clips[:1]), "clips").segments


@pytest.mark.parametrize("count", [1, 6])
def test_takes_without_splits_are_assigned_to_one_split_each(count, tmp_path):
    clips = [replace(clip, split="all") for clip in PEOPLE.clips[:count]]
    motion.save(tmp_path / "walks.npz", replace(PEOPLE, clips=clips))
    motion_set = SegmentData.open(tmp_path / "walks.npz").motion
    assert {*motion_set.splits} == {"train", "test"}
    assert count == 1 or [clip.frames for clip in motion_set] == [clip.frames for clip in clips]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda config: config["sizes"].update(turns=10**6), "sizes are .*, expected .* for the frames in `timed`"),
        (lambda config: config["timed"]["skeleton"].update(up="z"), "must be the skeleton of bodies, Pelvis"),
        (lambda config: config["timed"].update(frames=10**9), "frames is 1000000000; it must be"),
        (lambda config: config["timed"]["references"][0].update(hips=[[1, 0, 0, 0]]), "hips of a reference are"),
    ],
)
def test_an_invalid_schema_is_an_error(written, change, message):
    config = json.loads(written)
    change(config)
    with pytest.raises(ValueError, match=message):
        SegmentSchema.from_config(config)


def test_options_out_of_range_are_errors():
    for options, message in (({"cut": "steps"}, "unknown cut 'steps'"), ({"scaling": "own"}, "unknown scaling")):
        with pytest.raises(ValueError, match=message):
            SegmentData.open(**options)
    with pytest.raises(FileNotFoundError):
        SegmentData.open("nowhere.npz")
    with pytest.raises(TypeError, match="skip_bad"):
        SegmentSource("simulated", "", skip_bad="yes")
