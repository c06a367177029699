"""The demo of `make demo`: it resumes after an interruption and writes a page with the scores."""

from functools import partial

import pytest
from stopping import At, interrupt

import dvae
from benchmarks.studies import demo
from dvae import Evaluation
from dvae.runs.directory import resume


def test_the_demo_resumes_after_an_interruption(tmp_path, monkeypatch):
    resumed = []
    with monkeypatch.context() as patch:
        patch.setattr(demo.dvae, "fit", partial(dvae.fit, callbacks=[At(1, interrupt)]))
        with pytest.raises(KeyboardInterrupt):
            demo.main(tmp_path / "demo", share=0.005, samples=2, clips=10)
    monkeypatch.setattr(demo, "resume", lambda run: resumed.append(resume(run)) or resumed[-1])
    demo.main(tmp_path / "demo", share=0.005, samples=2, clips=10)
    assert [(fit.status, fit.step, fit.run.name) for fit in resumed] == [("finished", 2, "bom-parts")]
    rows = Evaluation.load(tmp_path / "demo" / "evaluation.json").rows
    assert rows.keys() == {"zero velocity", "nearest neighbours", *demo.STEPS}
    data = {"people.npz", "people.npz.labels.csv", "people.npz.skeleton.json"}
    names = {"evaluation.json", "futures.png", "report.html", "runs", *data}
    assert {file.name for file in (tmp_path / "demo").iterdir()} == names
    page = (tmp_path / "demo" / "report.html").read_text(encoding="utf-8")
    for row in rows:
        assert row in page
    assert "has changed since it was scored" not in page
