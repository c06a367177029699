"""Prints the table of docs/bounds.md: what three estimators of the evidence give where it is known."""

import torch

import dvae

STEPS, SEQUENCES, PARTICLES = 100, 200, 16
GUIDES = {
    "blind": "q(z_t | z_{t-1})",
    "mean-field": "q(z_t | x_{1:T})",
    "filtering": "q(z_t | z_{t-1}, x_t)",
    "exact": "q(z_t | z_{t-1}, x_{t:T})",
}


def row(name: str, inference: str) -> str:
    """Evidence minus each bound, for the best guide of the factorization."""
    model = dvae.twin("p(z_t | z_{t-1}) p(x_t | z_t)", inference, {"z": 1, "x": 1}, STEPS, scale=0.5)
    oracle = dvae.Oracle(model, STEPS)
    oracle.fit_guide(300)
    torch.manual_seed(0)
    x = model.sample(SEQUENCES, STEPS)["x"]
    with torch.no_grad():
        evidence = oracle.evidence(x)
        gaps = {"ELBO": evidence - oracle.bound(x)}
    gaps["IWAE"] = evidence - dvae.importance_bound(model, x, PARTICLES).bound
    for share in (0.25, 0.5, 1.0):
        gaps[f"FIVO {share}"] = evidence - dvae.particle_bound(model, x, PARTICLES, resample_below=share).bound
    cells = [f"{gap.mean():.2f} ± {gap.std() / SEQUENCES**0.5:.2f}" for gap in gaps.values()]
    return f"| `{inference.replace('|', chr(92) + '|')}`, {name} | {' | '.join(cells)} |"


if __name__ == "__main__":
    for name, inference in GUIDES.items():
        print(row(name, inference), flush=True)
