"""Panels with groups: batches have several windows of a group, and no window reveals another's future."""

import numpy as np
import pandas as pd
import pytest
import torch

import dvae
from dvae.tables import Column, Columns, Cut, PanelData


def panel(cut):
    random = np.random.default_rng(0)
    rows = [
        {"region": f"r{g}", "unit": f"{g}-{n}", "day": t, "y": random.normal(g)}
        for g in range(8)
        for n in range(3)
        for t in range(20)
    ]
    columns = Columns((Column("y"),), id=("unit",), time="day", group="region")
    return PanelData.of(pd.DataFrame(rows), columns, cut)


@pytest.fixture(scope="module")
def data():
    return panel(Cut(4, 4, split="group", validation=0.2, test=0.3))


OPTIONS = {"generative": "p(g) p(x_t | g)", "inference": "q(g | x_{1:T})", "grouped": ("g",), "latent": 1, "width": 8}


def test_windows_of_a_group_share_its_index_if_they_have_the_same_present(data):
    test = data.windows("test")
    groups = {one.name: one.group for one in data.panel.series}
    keys = [(groups[name], start) for _, name, start in test.keys]
    index = test.all()["group"].tolist()
    assert all((index[a] == index[b]) == (keys[a] == keys[b]) for a in range(len(keys)) for b in range(len(keys)))
    assert len({groups[name] for _, name, _ in test.keys}) == 3


def test_batches_for_training_have_several_windows_of_a_group(data):
    train = data.windows("train")
    batch = train.sample(20, torch.Generator().manual_seed(0))
    assert batch["group"].tolist() == sorted(batch["group"].tolist())
    assert batch["group"].bincount().max() >= 8
    means = torch.stack([batch["x"][batch["group"] == g].mean() for g in batch["group"].unique()])
    assert means.diff().abs().min() > 0.3  # each group has its own mean


def test_standard_errors_are_over_groups_if_sequences_share_a_latent(data):
    """Bounds of a group's sequences are equal shares of the group's bound: they do not vary independently."""
    model = dvae.method("equations", **OPTIONS).build(data.schema)
    test = data.windows("test")
    options = {"progress": False, "samples": 2}
    comparison = dvae.compare({"ours": model}, test, particles=5, contrasts=0, **options)
    assert "windows of 3 groups" in str(comparison)
    assert "clustered by group" in str(comparison)
    groups = np.unique([group for _, group, _ in test.cluster_keys], return_inverse=True)[1]
    bounds = comparison.rows["ours"].bounds["IWAE bound"][0]
    means = np.bincount(groups, bounds) / np.bincount(groups) / test.length
    assert comparison["ours"]["IWAE bound"].sequences == pytest.approx(means.std(ddof=1) / 3**0.5, rel=1e-6)
    sequences = panel(Cut(None, split="group", validation=0.2, test=0.3)).windows("test")
    bounds = str(dvae.compare({"ours": model}, sequences, particles=5, contrasts=0, samples=0, progress=False))
    assert "9 whole sequences of 3 groups" in bounds
    assert "over whole sequences (clustered by group)" in bounds
    scores = dvae.evaluate({"ours": model}, test, training_windows=data.windows("train"), **options)
    assert "windows of 3 groups" in str(scores)
    assert len(scores.rows["ours"].cluster_means["CRPS"]) == 3
    assert np.isfinite(scores["ours"]["CRPS"].standard_error)


def test_a_latent_of_the_group_is_learned_from_its_sequences(data):
    method = dvae.method("equations", **OPTIONS, warm_up=None)
    model = method.build(data.schema)
    recipe = method.train(data.windows("train"), data.windows("validation"), 150)
    dvae.fit(model, recipe, batch_size=32, learning_rate=1e-2, progress=False)
    batch = data.windows("test").all()
    together = dvae.iwae_bound(model, batch, particles=200).bound.mean()
    separate = dvae.iwae_bound(model, {"x": batch["x"]}, particles=200).bound.mean()
    assert together > separate + 0.1  # one KL term instead of several
