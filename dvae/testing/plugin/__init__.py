"""The pytest plugin: the fixture `elbo_regression` and its options.

pytest imports a plugin at every start, in every project of the environment. This package is therefore installed under a
second name, `pytest_dvae`, outside dvae, and imports dvae (and with it torch) only when the fixture is first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from dvae.testing.regression import ElboRegression

_OWNERS: pytest.StashKey[dict[Any, str]] = pytest.StashKey()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options --update-elbo and --elbo-strict."""
    group = parser.getgroup("dvae", "evidence bounds (dvae)")
    group.addoption("--update-elbo", action="store_true", help="renew the records of elbo_regression")
    group.addoption("--elbo-strict", action="store_true", help="fail where elbo_regression has no record yet")


def pytest_configure(config: pytest.Config) -> None:
    """Register the mark of the contract's test on a GPU."""
    config.addinivalue_line("markers", "gpu: computes on a GPU if there is one")


@pytest.fixture
def elbo_regression(request: pytest.FixtureRequest) -> ElboRegression:
    """Return the fixture whose `check(model, guide, data)` fails if the evidence bound is significantly worse."""
    from dvae.testing.regression import ElboRegression

    item, config = request.node, request.config
    return ElboRegression(
        folder=item.path.parent / "elbo_regression" / item.path.stem,
        test=item.nodeid.partition("::")[2].replace("::", "."),
        update=config.getoption("--update-elbo"),
        strict=config.getoption("--elbo-strict"),
        note=lambda line: item.user_properties.append(
            ("elbo_regression", line)
        ),  # xdist sends these to the main process
        owners=config.stash.setdefault(_OWNERS, {}),
    )


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """List new and renewed records, and improved bounds."""
    reports = [report for group in terminalreporter.stats.values() for report in group]
    properties = [entry for report in reports for entry in getattr(report, "user_properties", ())]
    if lines := dict.fromkeys(line for key, line in properties if key == "elbo_regression"):
        terminalreporter.section("evidence bounds")
        for line in lines:
            terminalreporter.line(line)
