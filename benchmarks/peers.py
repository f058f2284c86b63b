"""Other filters for the same models: FilterPy, NumPy on stacked matrices, JAX; each keeps everything of every row."""

from collections.abc import Callable

import numpy as np
from workloads import Array, Workload, flat

__all__ = ["filterpy_imm", "jax_unrolled", "jax_vmap", "numpy_stacked"]

Run = Callable[[], Callable[[], Array]]  # the work; what it returns gives the means, (batch, T, n)


def _outputs(batch: int, n_steps: int, n: int, modes: int) -> tuple[Array, Array, Array]:
    return np.empty((batch, n_steps, n)), np.empty((batch, n_steps, n, n)), np.empty((batch, n_steps, modes))


def filterpy_imm(w: Workload, z: Array) -> Run:
    """FilterPy's IMMEstimator, one track after another, on the flat chain."""
    from filterpy.kalman import IMMEstimator, KalmanFilter

    w = flat(w)
    M = len(w.trans[0])

    def one() -> IMMEstimator:
        filters = []
        for j in range(M):
            f = KalmanFilter(dim_x=w.n, dim_z=w.m)
            f.x, f.P, f.F, f.Q, f.H, f.R = np.zeros(w.n), np.eye(w.n), w.F[j], w.Q[j], w.H[j], w.R[j]
            filters.append(f)
        return IMMEstimator(filters, np.full(M, 1.0 / M), w.trans[0])

    def run() -> Callable[[], Array]:
        batch, n_steps = z.shape[:2]
        mean, cov, probs = _outputs(batch, n_steps, w.n, M)
        for i in range(batch):
            imm = one()
            for k in range(n_steps):
                imm.predict()
                imm.update(z[i, k])
                mean[i, k], cov[i, k], probs[i, k] = imm.x, imm.P, imm.mu
        return lambda: mean

    return run


def numpy_stacked(w: Workload, z: Array) -> Run:
    """A good vectorised IMM: matrices stacked over tracks and modes, matmul and solve, covariances symmetrised."""
    w = flat(w)
    trans, M, n = w.trans[0], len(w.trans[0]), w.n
    logdet_2pi = w.m * np.log(2 * np.pi)

    def step(mu: Array, x: Array, P: Array, zk: Array) -> tuple[Array, Array, Array]:
        joint = mu[:, :, None] * trans
        c = joint.sum(1)
        weight = (joint / c[:, None, :]).swapaxes(1, 2)  # (B, to, from)
        x0 = weight @ x
        gap = x[:, None] - x0[:, :, None]
        P0 = (weight @ P.reshape(-1, M, n * n)).reshape(-1, M, n, n)
        P0 += (weight[..., None] * gap).swapaxes(-1, -2) @ gap
        x = (w.F @ x0[..., None])[..., 0]
        P = w.F @ P0 @ w.F.swapaxes(-1, -2) + w.Q
        PH = P @ w.H.swapaxes(-1, -2)
        S = w.H @ PH + w.R
        nu = zk[:, None] - (w.H @ x[..., None])[..., 0]
        solved = np.linalg.solve(S, np.concatenate([PH.swapaxes(-1, -2), nu[..., None]], axis=-1))
        K = solved[..., :n].swapaxes(-1, -2)
        x = x + (K @ nu[..., None])[..., 0]
        P = P - K @ PH.swapaxes(-1, -2)
        P = 0.5 * (P + P.swapaxes(-1, -2))
        log_f = -0.5 * ((nu * solved[..., n]).sum(-1) + np.log(np.linalg.det(S)) + logdet_2pi)
        mu = c * np.exp(log_f - log_f.max(1, keepdims=True))
        return mu / mu.sum(1, keepdims=True), x, P

    def run() -> Callable[[], Array]:
        batch, n_steps = z.shape[:2]
        mean, cov, probs = _outputs(batch, n_steps, n, M)
        mu, x, P = np.full((batch, M), 1.0 / M), np.zeros((batch, M, n)), np.broadcast_to(np.eye(n), (batch, M, n, n))
        for k in range(n_steps):
            mu, x, P = step(mu, x, P, z[:, k])
            m = (mu[:, None] @ x)[:, 0]
            gap = x - m[:, None]
            mean[:, k], probs[:, k] = m, mu
            cov[:, k] = (mu[:, None] @ P.reshape(-1, M, n * n)).reshape(-1, n, n)
            cov[:, k] += (mu[..., None] * gap).swapaxes(1, 2) @ gap
        return lambda: mean

    return run


def jax_vmap(w: Workload, z: Array) -> Run:
    """JAX as one would write it: one track with matmul and solve, `vmap` over tracks, `scan` over time, `jit`."""
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    w = flat(w)
    F, Q, H, R, trans = map(jnp.asarray, (w.F, w.Q, w.H, w.R, w.trans[0]))
    M, n = len(w.trans[0]), w.n

    def step(carry, zk):
        mu, x, P = carry
        joint = mu[:, None] * trans
        c = joint.sum(0)
        weight = (joint / c).T
        x0 = weight @ x
        gap = x[None] - x0[:, None]
        P0 = jnp.einsum("ji,iab->jab", weight, P) + jnp.einsum("ji,jia,jib->jab", weight, gap, gap)
        x = jnp.einsum("jab,jb->ja", F, x0)
        P = F @ P0 @ F.swapaxes(-1, -2) + Q
        PH = P @ H.swapaxes(-1, -2)
        S = H @ PH + R
        nu = zk - jnp.einsum("jab,jb->ja", H, x)
        L = jnp.linalg.cholesky(S)
        G = jax.scipy.linalg.solve_triangular(L, PH.swapaxes(-1, -2), lower=True)
        e = jax.scipy.linalg.solve_triangular(L, nu[..., None], lower=True)
        x = x + (G.swapaxes(-1, -2) @ e)[..., 0]
        P = P - G.swapaxes(-1, -2) @ G
        log_f = -0.5 * (e[..., 0] ** 2).sum(-1) - jnp.log(jnp.diagonal(L, axis1=-2, axis2=-1)).sum(-1)
        mu = c * jnp.exp(log_f - log_f.max())
        mu = mu / mu.sum()
        mean = mu @ x
        gap = x - mean
        cov = jnp.einsum("i,iab->ab", mu, P) + jnp.einsum("i,ia,ib->ab", mu, gap, gap)
        return (mu, x, P), (mean, cov, mu)

    def track(zi):
        start = (jnp.full(M, 1.0 / M), jnp.zeros((M, n)), jnp.broadcast_to(jnp.eye(n), (M, n, n)))
        return jax.lax.scan(step, start, zi)[1]

    return _compiled(jax, jax.vmap(track), jnp.asarray(z), lambda out: np.asarray(out[0]))


def jax_unrolled(w: Workload, z: Array) -> Run:
    """JAX as fast as we know: every matrix element an array (modes, tracks), the algebra unrolled, chains apart."""
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    n, m, sizes = w.n, w.m, w.sizes
    M, batch = int(np.prod(sizes)), z.shape[0]

    def elements(a):  # (rows, cols) of (M, 1)
        full = np.broadcast_to(a, (*sizes, *a.shape[-2:])).reshape(M, *a.shape[-2:])
        return [[jnp.asarray(full[:, i, j][:, None]) for j in range(full.shape[2])] for i in range(full.shape[1])]

    F, Q, H, R = map(elements, (w.F, w.Q, w.H, w.R))

    def along(a, c, weights):  # sum over `from` of weights (from, to, rest, B) a (from, rest, B)
        moved = jnp.moveaxis(a.reshape((*sizes, batch)), c, 0)
        out = sum(weights[i] * moved[i][None] for i in range(sizes[c]))
        return jnp.moveaxis(out, 0, c).reshape(M, batch)

    def mix(p, x, P):
        for c, t in enumerate(w.trans):
            moved = jnp.moveaxis(p.reshape((*sizes, batch)), c, 0)
            lift = (sizes[c], sizes[c]) + (1,) * (moved.ndim - 1)
            joint = jnp.asarray(t).reshape(lift) * moved[:, None]
            q = joint.sum(0)
            weights = joint / q
            x_new = [along(xi, c, weights) for xi in x]

            def gap(i, source, x=x, x_new=x_new, c=c):
                old = jnp.moveaxis(x[i].reshape((*sizes, batch)), c, 0)[source]
                return old[None] - jnp.moveaxis(x_new[i].reshape((*sizes, batch)), c, 0)

            gaps = [[gap(i, s) for s in range(sizes[c])] for i in range(n)]
            P_new = {}
            for i in range(n):
                for j in range(i + 1):
                    spread = sum(weights[s] * gaps[i][s] * gaps[j][s] for s in range(sizes[c]))
                    P_new[i, j] = along(P[i, j], c, weights) + jnp.moveaxis(spread, 0, c).reshape(M, batch)
            p, x, P = jnp.moveaxis(q, 0, c).reshape(M, batch), x_new, P_new
        return p, x, P

    def sym(P, i, j):
        return P[max(i, j), min(i, j)]

    def update(x, P, zk):
        U = [[sum(sym(P, i, k) * H[a][k] for k in range(n)) for a in range(m)] for i in range(n)]
        L, nu = {}, [zk[a][None] - sum(H[a][k] * x[k] for k in range(n)) for a in range(m)]
        log_det, d2, e = 0.0, 0.0, []
        for a in range(m):
            for b in range(a + 1):
                s = sum(H[a][k] * U[k][b] for k in range(n)) + R[a][b] - sum(L[a, c] * L[b, c] for c in range(b))
                L[a, b] = jnp.sqrt(s) if a == b else s / L[b, b]
            e.append((nu[a] - sum(L[a, c] * e[c] for c in range(a))) / L[a, a])
            log_det, d2 = log_det + jnp.log(L[a, a]), d2 + e[a] ** 2
        G = [[] for _ in range(n)]
        for i in range(n):
            for a in range(m):
                G[i].append((U[i][a] - sum(L[a, c] * G[i][c] for c in range(a))) / L[a, a])
        x = [x[i] + sum(G[i][a] * e[a] for a in range(m)) for i in range(n)]
        P = {(i, j): P[i, j] - sum(G[i][a] * G[j][a] for a in range(m)) for i, j in P}
        return x, P, -0.5 * d2 - log_det

    def step(carry, zk):
        p, x, P = mix(*carry)
        FP = [[sum(F[i][k] * sym(P, k, j) for k in range(n)) for j in range(n)] for i in range(n)]
        P = {(i, j): sum(FP[i][k] * F[j][k] for k in range(n)) + Q[i][j] for i in range(n) for j in range(i + 1)}
        x = [sum(F[i][k] * x[k] for k in range(n)) for i in range(n)]
        x, P, log_f = update(x, P, zk)
        p = p * jnp.exp(log_f - log_f.max(0))
        p = p / p.sum(0)
        mean = [(p * x[i]).sum(0) for i in range(n)]
        gap = [x[i] - mean[i] for i in range(n)]
        cov = [[(p * (sym(P, i, j) + gap[i] * gap[j])).sum(0) for j in range(n)] for i in range(n)]
        return (p, x, P), (jnp.stack(mean), jnp.stack([jnp.stack(row) for row in cov]), p)

    def filter_all(zt):  # (T, m, B)
        x = [jnp.zeros((M, batch)) for _ in range(n)]
        P = {(i, j): jnp.full((M, batch), float(i == j)) for i in range(n) for j in range(i + 1)}
        return jax.lax.scan(step, (jnp.full((M, batch), 1.0 / M), x, P), zt)[1]

    zt = jnp.asarray(np.ascontiguousarray(z.transpose(1, 2, 0)))
    return _compiled(jax, filter_all, zt, lambda out: np.asarray(out[0]).transpose(2, 0, 1))


def _compiled(jax, function, argument, mean_of) -> Run:
    compiled = jax.jit(function).lower(argument).compile()

    def run() -> Callable[[], Array]:
        out = jax.block_until_ready(compiled(argument))
        return lambda: mean_of(out)

    return run
