"""Random hybrid models: hypothesis draws structure and a seed, NumPy the numbers.

Drawing every matrix element would shrink to zeros, where nothing can go wrong.
"""

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st

__all__ = [
    "coloured_problems",
    "law",
    "problems",
    "quick",
    "random_coloured",
    "random_cov",
    "random_problem",
    "random_trans",
    "rngs",
]

# The same examples on every machine; a deadline would be a timing assertion.
quick = settings(max_examples=25, deadline=None, derandomize=True)


def rngs():
    return st.integers(0, 2**32 - 1).map(np.random.default_rng)


def random_cov(rng, lead, n):
    """Well-conditioned covariances, (*lead, n, n)."""
    a = rng.normal(size=(*lead, n, n))
    return a @ a.swapaxes(-1, -2) / n + 0.2 * np.eye(n)


def law(rng, lead, m):
    """Probabilities over the last axis, none tiny."""
    p = rng.uniform(0.1, 1.0, size=(*lead, m))
    return p / p.sum(-1, keepdims=True)


def random_trans(rng, m, lead=()):
    """A transition matrix with distinct rows; its transpose is none."""
    return 0.6 * np.eye(m) + 0.4 * law(rng, (*lead, m), m)


def _lead(rng, batch, n_steps, sizes):
    """Axes a model array may have: some chains, perhaps time, perhaps runs."""
    modes = tuple(int(rng.choice([1, s])) for s in sizes)
    kind = rng.integers(3 if batch else 2)
    time = int(rng.choice([1, n_steps]))
    return (modes, (n_steps, *modes), (*batch, time, *modes))[kind]


def _prior_lead(rng, batch, sizes):
    modes = tuple(int(rng.choice([1, s])) for s in sizes)
    return ((), modes, (*batch, *modes))[rng.integers(3)]


def random_problem(rng, sizes=(2,), n=2, m=1, n_steps=4, batch=(), missing=0.2):
    """Arguments of `imm_filter` in which each array has its own axes, drawn at random."""

    def lead():
        return _lead(rng, batch, n_steps, sizes)

    def transition(size):
        kind = rng.integers(4 if batch else 3)
        if kind == 0:
            return random_trans(rng, size)
        if kind == 1:
            return np.eye(size)
        return random_trans(rng, size, ((n_steps,), (*batch, int(rng.choice([1, n_steps]))))[kind - 2])

    n_modes = int(np.prod(sizes))
    probs_lead = batch if rng.random() < 0.5 else ()
    z = 2.0 * rng.normal(size=(*batch, n_steps, m))
    z[rng.random(z.shape) < missing] = np.nan
    return {
        "z": z,
        "F": np.eye(n) + 0.3 * rng.normal(size=(*lead(), n, n)),
        "Q": random_cov(rng, lead(), n),
        "H": rng.normal(size=(*lead(), m, n)),
        "R": random_cov(rng, lead(), m),
        "trans": [transition(s) for s in sizes],
        "mean0": rng.normal(size=(*_prior_lead(rng, batch, sizes), n)),
        "cov0": random_cov(rng, _prior_lead(rng, batch, sizes), n),
        "probs0": law(rng, probs_lead, n_modes).reshape((*probs_lead, *sizes)),
        "b": rng.normal(size=(*lead(), n)) if rng.random() < 0.5 else None,
        "d": rng.normal(size=(*lead(), m)) if rng.random() < 0.5 else None,
    }


@st.composite
def problems(draw, max_chains=3, max_modes=12, max_batch=2):
    """Any number of chains and leading axes, missing components, time-varying and per-run arrays."""
    sizes = tuple(draw(st.lists(st.integers(1, 3), min_size=0, max_size=max_chains)))
    while np.prod(sizes) > max_modes:
        sizes = sizes[:-1]
    batch = tuple(draw(st.lists(st.integers(1, 3), min_size=0, max_size=max_batch)))
    rng = draw(rngs())
    n, m, n_steps = draw(st.integers(1, 4)), draw(st.integers(1, 3)), draw(st.integers(1, 5))
    return random_problem(rng, sizes, n, m, n_steps, batch)


def random_coloured(rng, sizes=(2,), n=2, m=1, n_steps=5, batch=(), missing=0.3, irregular=True):
    """Arguments of `coloured_filter`; each matrix depends on some of the chains."""

    def lead():
        return tuple(int(rng.choice([1, s])) for s in sizes)

    z = 2.0 * rng.normal(size=(*batch, n_steps + 1, m))
    z[rng.random(z.shape) < missing] = np.nan
    eye = np.eye(max(n, m))
    noise_lead = ((), lead())[rng.integers(2)]
    n_modes = int(np.prod(sizes))
    return {
        "z": z,
        "F": -0.3 * eye[:n, :n] + 0.5 * rng.normal(size=(*lead(), n, n)),
        "G": rng.normal(size=(*lead(), n, n)) + 0.3 * eye[:n, :n],
        "noise_F": -0.8 * eye[:m, :m] + 0.3 * rng.normal(size=(*lead(), m, m)),
        "noise_G": rng.normal(size=(*lead(), m, m)) + 0.5 * eye[:m, :m],
        "H": rng.normal(size=(m, n)),
        "dt": rng.uniform(0.1, 1.5, n_steps) if irregular else 0.7,
        "trans": [random_trans(rng, s, ((), (n_steps,))[rng.integers(2)]) for s in sizes],
        "mean0": rng.normal(size=((), (*sizes,))[rng.integers(2)] + (n,)),
        "cov0": random_cov(rng, ((), lead())[rng.integers(2)], n),
        "noise_cov0": random_cov(rng, noise_lead, m),
        "probs0": law(rng, (), n_modes).reshape(sizes),
    }


@st.composite
def coloured_problems(draw):
    sizes = tuple(draw(st.lists(st.integers(1, 3), min_size=0, max_size=3)))
    batch = tuple(draw(st.lists(st.integers(1, 3), min_size=0, max_size=1)))
    rng = draw(rngs())
    n, m, n_steps = draw(st.integers(1, 4)), draw(st.integers(1, 3)), draw(st.integers(1, 7))
    missing = draw(st.sampled_from([0.0, 0.2, 0.7]))
    return random_coloured(rng, sizes, n, m, n_steps, batch, missing, draw(st.booleans()))


def spread_cov(rng, lead, n, full=0.5):
    """Covariances of any rank, in units of their own variances: half of them, by `full`, of full rank."""
    root = rng.normal(size=(*lead, n, n))
    rank = np.where(rng.random(lead) < full, n, rng.integers(0, n + 1, size=lead))
    root = root * (np.arange(n) < rank[..., None])[..., None, :]
    cov = root @ root.swapaxes(-1, -2)
    return 0.5 * (cov + cov.swapaxes(-1, -2))


def hostile_problem(rng, runs, sizes, n, m, n_steps, decades=8.0, farthest=150.0, noisy=False):
    """Arguments of `imm_filter` for runs of all kinds, each with its own model: what double precision has to bear.

    Standard deviations of the prior, of the process and of the measurements' noise differ by up to 10^`decades` either
    way; covariances of any rank, none included; components without noise, measurements of one thing, more of them than
    states; a tenth of the measurements is up to 10^`farthest` times too large, a tenth is missing. `noisy`: every
    component has noise of its own, so that what is measured twice cannot contradict itself.
    """
    modes = (1,) * len(sizes)

    def ten(low, high, *shape):
        return 10.0 ** rng.uniform(low, high, size=(runs, *shape))

    def scaled(cov, by):
        return cov * by[..., :, None] * by[..., None, :]

    unit = ten(-3, 3, n)  # of each state: metres beside degrees
    noise = ten(-decades, decades, 1) * ten(-1, 1, m)
    H = rng.normal(size=(runs, m, n)) / unit[:, None, :]
    same = rng.random(runs) < 0.2
    H[same] = H[same, :1]
    R = scaled(spread_cov(rng, (runs,), m, full=1.0 if noisy else 0.8), noise)
    diagonal, silent = rng.random(runs) < 0.5, rng.random((runs, m)) < (0.0 if noisy else 0.1)
    R = np.where(diagonal[:, None, None], R * np.eye(m), R) * ~silent[:, :, None] * ~silent[:, None, :]
    R = R.reshape(runs, 1, *modes, m, m) * ten(-4, 4, 1, *sizes, 1, 1)
    F = np.eye(n) + 0.3 / n * rng.normal(size=(runs, n, n)) * unit[:, :, None] / unit[:, None, :]
    Q = scaled(spread_cov(rng, (runs,), n), unit * ten(-decades, 0, 1))
    z = rng.normal(size=(runs, n_steps, m)) * (1.0 + noise[:, None])
    z = np.where(rng.random(z.shape) < 0.1, z * ten(0, min(farthest, 295.0), n_steps, m), z)
    z[rng.random(z.shape) < 0.1] = np.nan
    n_modes = int(np.prod(sizes))
    return {
        "z": z,
        "F": F.reshape(runs, 1, *modes, n, n),
        "Q": Q.reshape(runs, 1, *modes, n, n) * ten(-2, 2, 1, *sizes, 1, 1),
        "H": H.reshape(runs, 1, *modes, m, n),
        "R": R,
        "trans": [random_trans(rng, s) for s in sizes],
        "mean0": (unit * rng.normal(size=(runs, n))).reshape(runs, *modes, n),
        "cov0": scaled(spread_cov(rng, (runs,), n), unit).reshape(runs, *modes, n, n),
        "probs0": law(rng, (), n_modes).reshape(sizes),
    }  # fmt: skip


@st.composite
def hostile_problems(draw, most_states=9, most_steps=4, chains=((), (2,), (3,), (2, 2)), farthest=300.0, noisy=False):
    """`hostile_problem` of one to nine states and up to two measurements more than states, up to overflow."""
    n = draw(st.integers(1, most_states))
    m, n_steps, runs = draw(st.integers(1, n + 2)), draw(st.integers(1, most_steps)), draw(st.integers(1, 5))
    size = draw(st.sampled_from([f for f in (0.0, 3.0, 16.0, 150.0, 300.0) if f <= farthest]))
    decades = draw(st.sampled_from([2.0, 8.0]))
    return hostile_problem(draw(rngs()), runs, draw(st.sampled_from(chains)), n, m, n_steps, decades, size, noisy)


def of_runs(p, which):
    """Arguments of `hostile_problem` for some of its runs."""
    return {name: a if name in ("trans", "probs0") else a[which] for name, a in p.items()}
