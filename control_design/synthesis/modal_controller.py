"""A matrix controller in real modal form, as the optimiser sees it: values and slopes in its parameters.

    K(s) = D + C_0 / s + sum_b C_b (s / w_b - M_b)^-1 B_b,   M_b = [[0, 1], [-1, -2 zeta_b]],

two states per block b, s of Tustin's rule. `ModalForm` knows which entries of K may differ from zero (its
pattern), and writes K with the parameters log w_b, log zeta_b, then the free entries of C, B, D and C_0. A
block belongs to the rows and columns of K that its masks name, so that zeros of K stay zeros.

`response` and `slopes` evaluate many parameter vectors at many frequencies; `spread` and `realised` give
parameters to begin with; `continuous` and `discrete` give the state space. In shapes: P parameter vectors of
n parameters, R frequencies, m blocks, U actuators, Y outputs, i integrators.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from control_design.plants.ellipses import Boolean, Complex, Real

# Highest corner of a block, in units of the scale; the scale is where the loop crosses, about, and corners
# that much faster are a gain to it. Chosen.
_FASTEST = 60.0
# Highest damping ratio of a block: two real poles (2 zeta)^2 = 10^4 apart, nearly any pair of real poles.
_MOST_DAMPED = 50.0
# Least natural unit of D. Where a part of K vanishes, its own size as its unit would keep it there. Far below
# any gain that is used.
_LEAST_GAIN = 1e-9
# Least natural unit of B, whose blocks begin with entries of one: small beside them. Chosen.
_LEAST_B = 1e-3
# Least natural unit of C, over the gain of D over the size of B. Doubled, an idle block takes larger first
# steps, and problem T of `benchmarks.mimo_designs` ends 8 % (full) and 27 % (decentralised) higher after
# six rounds.
_LEAST_C_OF_GAIN = 0.05
# Least natural unit of C_0, over the gain of D times the scale: integral action with a corner of a hundredth
# of the scale. Chosen.
_LEAST_C_0_OF_GAIN = 0.01
# Imaginary part, of the modulus, up to which a pole counts as real: rounding of an eigenvalue, above the
# 1e-16 of a single one, below the 1e-8 of a double one.
_REAL = 1e-9
# Coordinates of a block that are tried, evenly over half a turn, every 7.5 degrees; the best has the smallest
# norms of C and B. Chosen: a start only.
_TURNS = 24
# Condition number of coordinates beyond which they are no basis: two poles coincide, or the angle is unlucky.
# Seven digits are left there.
_WORST_CONDITION = 1e9


class ModalParts(NamedTuple):
    """Parts of P parameter vectors, or of one without the first axis.

    Attributes
    ----------
    log_w, log_zeta : ndarray, shape (P, m)
        Logarithms of corner, rad/s, and damping ratio of each block.
    C : ndarray, shape (P, m, U, 2)
    B : ndarray, shape (P, m, 2, Y)
    D : ndarray, shape (P, U, Y)
        Command per error, as C B is.
    C_0 : ndarray, shape (P, U, i)
        Gains of the integrators, D's unit times rad/s.
    """

    log_w: Real
    log_zeta: Real
    C: Real
    B: Real
    D: Real
    C_0: Real


class ModalForm:
    """Structure of K (U, Y), and the map between parameters and K.

    Parameters
    ----------
    pattern : ndarray of bool, shape (U, Y)
        Entries of K that may differ from zero.
    order : int
        Number of states: one for each integrator, two for each block.
    integrates : ndarray of bool, shape (Y,)
        Outputs that are integrated.
    scale_rad_s : float
        Frequency around which the controller acts.
    slowest_rad_s : float
        Lowest corner of a block, below `_FASTEST` scales.
    dt_s : float
        Sampling period, seconds; used by `discrete` only.
    damping : float
        Least damping ratio of a block, positive and below `_MOST_DAMPED`. Like the frequencies it is not
        checked; its logarithm is taken.

    Raises
    ------
    ValueError
        The order is not one for each integrator and two for each block. A pattern with zeros and no entry at
        all is a ZeroDivisionError, if there are blocks.
    """

    def __init__(
        self,
        pattern: Boolean,
        order: int,
        integrates: Boolean,
        scale_rad_s: float,
        slowest_rad_s: float,
        dt_s: float,
        damping: float,
    ) -> None:
        """Find the free entries of every part, and where each part stands in the parameter vector; refuses an
        order that does not fit (ValueError, see the class)."""
        self.pattern = pattern
        self.scale = scale_rad_s
        self.slowest = slowest_rad_s
        self.dt_s = dt_s
        self.damping = damping
        self.inputs, self.outputs = pattern.shape
        self.integrates = np.flatnonzero(integrates)
        block_states = order - self.integrates.size
        if block_states < 0 or block_states % 2:
            raise ValueError(
                f"controller_order must be {self.integrates.size} (integrators) and two per modal block; "
                f"got {order}"
            )
        self.order = order
        self.blocks = block_states // 2

        # Rows and columns of K that each block belongs to.
        row_mask = np.zeros((self.blocks, self.inputs), bool)
        column_mask = np.zeros((self.blocks, self.outputs), bool)
        for block, (rows, columns) in enumerate(_rectangles(pattern, self.blocks)):
            row_mask[block] = rows
            column_mask[block] = columns

        # Positions of free entries in C (m, U, 2), B (m, 2, Y), D (U, Y), C_0 (U, i).
        free_in_c = np.repeat(row_mask[:, :, None], 2, axis=2)
        free_in_b = np.repeat(column_mask[:, None, :], 2, axis=1)
        self._c = np.nonzero(free_in_c)
        self._b = np.nonzero(free_in_b)
        self._d = np.nonzero(pattern)
        self._i = np.nonzero(pattern[:, self.integrates])
        free_entries = [positions[0].size for positions in (self._c, self._b, self._d, self._i)]
        self.ends = np.cumsum([self.blocks, self.blocks, *free_entries])
        self.parameters = int(self.ends[-1])

    # Parameter vectors and their parts

    def split(self, x: Real) -> ModalParts:
        """Parts of parameter vectors.

        Parameters
        ----------
        x : ndarray, shape (P, n)
            Fewer columns are numpy's ValueError; what stands beyond n is left out.

        Returns
        -------
        ModalParts
            Entries that the pattern forbids are zero.
        """
        count = x.shape[0]
        log_w, log_zeta, c, b, d, c_0, _ = np.split(x, self.ends, axis=1)
        C = np.zeros((count, self.blocks, self.inputs, 2))
        B = np.zeros((count, self.blocks, 2, self.outputs))
        D = np.zeros((count, self.inputs, self.outputs))
        C_0 = np.zeros((count, self.inputs, self.integrates.size))
        every: Any = slice(None)
        # A vector's numbers stand in the order of the free entries.
        C[(every, *self._c)] = c
        B[(every, *self._b)] = b
        D[(every, *self._d)] = d
        C_0[(every, *self._i)] = c_0
        return ModalParts(log_w, log_zeta, C, B, D, C_0)

    def _split_one(self, x: Real) -> ModalParts:
        """Parts, without the first axis, of one parameter vector (n,)."""
        return ModalParts(*(part[0] for part in self.split(x[None])))

    def join(self, log_w: Real, log_z: Real, C: Real, B: Real, D: Real, C_0: Real) -> Real:
        """Parameters of one controller from its parts.

        Parameters
        ----------
        log_w, log_z, C, B, D, C_0 : ndarray
            As in `ModalParts`, without the first axis.

        Returns
        -------
        ndarray, shape (n,)
            What the pattern forbids is left out.
        """
        return np.concatenate([log_w, log_z, C[self._c], B[self._b], D[self._d], C_0[self._i]])

    def bounds(self) -> tuple[Real, Real]:
        """Least and largest value (n,) of every parameter: corners from `slowest` to `_FASTEST` scales,
        damping ratios from `damping` to `_MOST_DAMPED`, as logarithms; C, B, D and C_0 are free."""
        low = np.full(self.parameters, -np.inf)
        high = np.full(self.parameters, np.inf)
        m = self.blocks
        low[:m] = np.log(self.slowest)
        high[:m] = np.log(_FASTEST * self.scale)
        low[m : 2 * m] = np.log(self.damping)
        high[m : 2 * m] = np.log(_MOST_DAMPED)
        return low, high

    def units(self, x: Real) -> Real:
        """A substantial change of each parameter.

        Parameters
        ----------
        x : ndarray, shape (n,)
            Where the change starts from.

        Returns
        -------
        ndarray, shape (n,)
            1 for logarithms; root mean squares of D, of each block's B and C, and of C_0, with a least value
            that lets an idle block begin to move. All positive for finite x.
        """
        parts = self._split_one(x)
        direct_gain = float(np.sqrt(np.mean(parts.D[self.pattern] ** 2)))
        gain = max(direct_gain, _LEAST_GAIN)
        size_of_b = np.sqrt(np.mean(parts.B**2, axis=(1, 2)))
        of_b = np.maximum(size_of_b, _LEAST_B)
        size_of_c = np.sqrt(np.mean(parts.C**2, axis=(1, 2)))
        of_c = np.maximum(size_of_c, _LEAST_C_OF_GAIN * gain / of_b)
        integral_gain = float(np.sqrt(np.mean(parts.C_0**2))) if parts.C_0.size else 0.0
        of_c_0 = max(integral_gain, _LEAST_C_0_OF_GAIN * gain * self.scale)

        # One unit for all entries of a part, in the shape of the part.
        ones = np.ones(self.blocks)
        C = of_c[:, None, None] * np.ones_like(parts.C)
        B = of_b[:, None, None] * np.ones_like(parts.B)
        D = gain * np.ones_like(parts.D)
        C_0 = of_c_0 * np.ones_like(parts.C_0)
        return self.join(ones, ones, C, B, D, C_0)

    # Parameters to begin with

    def spread(self, lowest: float, highest: float, zeta: float) -> tuple[Real, Real, Real, Real]:
        """Blocks with corners spread over frequency that do nothing yet.

        Parameters
        ----------
        lowest, highest : float
            First and last corner, in units of the scale, positive; logarithmic between them.
        zeta : float
            Damping ratio, if not less than the form's least.

        Returns
        -------
        log_w, log_zeta : ndarray, shape (m,)
        C : ndarray, shape (m, U, 2)
            Zero.
        B : ndarray, shape (m, 2, Y)
            Entries of 1 and 0.

        Notes
        -----
        Where blocks belong to one actuator each, every corner serves one block of each actuator, with all
        outputs into the first state. Else the states take the outputs in turn.
        """
        blocks_per_corner = 1 if self.pattern.all() else self.inputs
        # At least one corner, the number of blocks over that of a corner rounded up.
        corner_count = max(-(-self.blocks // blocks_per_corner), 1)
        corners = np.geomspace(lowest, highest, corner_count) * self.scale
        B = np.zeros((self.blocks, 2, self.outputs))
        for block, state in np.ndindex(self.blocks, 2):
            if blocks_per_corner == 1:
                B[block, state, (block + state) % self.outputs] = 1.0
            elif state == 0:
                B[block, state] = 1.0
        log_w = np.log(np.repeat(corners, blocks_per_corner)[: self.blocks])
        log_zeta = np.full(self.blocks, np.log(max(zeta, self.damping)))
        return log_w, log_zeta, np.zeros((self.blocks, self.inputs, 2)), B

    def realised(self, A: Real, B: Real, C: Real, D: Real) -> Real | None:
        """Parameters of a full controller that is known as a continuous state space.

        Parameters
        ----------
        A, B, C, D : ndarray
            Of K(s), time in seconds, with as many states as the form (not checked: other numbers of poles
            are an IndexError) and U commands of Y errors; for a full pattern.

        Returns
        -------
        ndarray, shape (n,), or None
            Unstable poles are mirrored, the slowest real ones become the integrators, and corners and
            dampings are moved into their bounds. Every block has unit norm at its input. None where real
            poles do not pair, or two poles of a pair are the same.

        Raises
        ------
        numpy.linalg.LinAlgError
            A is not finite, or its eigenvectors are no basis.

        Notes
        -----
        A pair of poles is brought from diagonal form, a = diag(poles) / w = T M T^-1, to that of a block.
        Every T = [v, -a v] does so, with v real, or of conjugates for a complex pair. v is determined up to
        an angle; that one is taken at which the norms of B and C are smallest.
        """
        poles, axes = np.linalg.eig(A)
        inverse = np.linalg.inv(axes)
        is_real = np.abs(poles.imag) <= _REAL * np.abs(poles)
        upper = np.flatnonzero(poles.imag > _REAL * np.abs(poles))
        real = sorted(np.flatnonzero(is_real), key=lambda k: abs(poles[k]))
        slow = real[: self.integrates.size]
        real = real[self.integrates.size :]
        if len(real) % 2 or len(slow) < self.integrates.size:
            return None
        poles = -np.abs(poles.real) + 1j * poles.imag

        # Two poles for every block: a pole and its conjugate, or neighbours among the real ones.
        pairs = []
        for k in upper:
            distances = np.abs(poles - np.conj(poles[k]))
            pairs.append(np.array([k, np.argmin(distances)]))
        for first in range(0, len(real), 2):
            pairs.append(np.array(real[first : first + 2]))
        log_w, log_zeta, C_blocks, B_blocks = self.spread(1.0, 1.0, 1.0)
        for block, pair in enumerate(pairs):
            both_poles = poles[pair]
            geometric_mean = float(np.sqrt(np.prod(both_poles).real))
            w = max(geometric_mean, np.finfo(float).tiny)
            a = np.diag(both_poles) / w
            # What goes into the two diagonal states, and what comes out of them.
            into_pair = inverse[pair] @ B / w
            out_of_pair = C @ axes[:, pair]
            candidates = []
            for angle in np.linspace(0, np.pi, _TURNS, endpoint=False):
                if block < upper.size:
                    v = np.exp([1j * angle, -1j * angle])
                else:
                    v = np.array([np.cos(angle), np.sin(angle)])
                T = np.column_stack([v, -a @ v])
                if np.linalg.cond(T) < _WORST_CONDITION:
                    into_block = np.linalg.solve(T, into_pair).real
                    out_of_block = (out_of_pair @ T).real
                    norms = float(np.linalg.norm(into_block) * np.linalg.norm(out_of_block))
                    candidates.append((norms, into_block, out_of_block))
            if not candidates:
                return None
            _, b, c = min(candidates, key=lambda candidate: candidate[0])
            size = float(np.linalg.norm(b)) or 1.0
            log_w[block] = np.log(w)
            log_zeta[block] = np.log(-np.sum(both_poles).real / (2 * w))
            C_blocks[block] = c * size
            B_blocks[block] = b / size
        # Residues of the slowest poles are the integrators' gains.
        residues = (C @ axes[:, slow] @ inverse[slow] @ B).real
        C_0 = residues[:, self.integrates]
        x = self.join(log_w, log_zeta, C_blocks, B_blocks, D, C_0)
        return np.clip(x, *self.bounds())

    # Values and slopes

    def _resolvent(self, log_w: Real, log_z: Real, s: Complex) -> tuple[Complex, Complex]:
        """s / w (P, R, m) and (s / w - M)^-1 (P, R, m, 2, 2) of blocks (P, m) at s (R,), without unit.

        log_w, log_z (P, m): logarithms of corner, rad/s, and damping ratio. s on a pole of a block would give
        inf; s on the imaginary axis never is, as damping is positive.
        """
        w = np.exp(log_w)
        zeta = np.exp(log_z)
        ratio = s[None, :, None] / w[:, None, :]
        swing = ratio + 2 * zeta[:, None, :]
        # Inverse of [[s/w, -1], [1, s/w + 2 zeta]] in closed form.
        E = np.empty((*ratio.shape, 2, 2), dtype=np.complex128)
        E[..., 0, 0] = swing
        E[..., 0, 1] = 1.0
        E[..., 1, 0] = -1.0
        E[..., 1, 1] = ratio
        determinant = ratio * swing + 1.0
        E /= determinant[..., None, None]
        return ratio, E

    def response(self, x: Real, s: Complex) -> Complex:
        """Values of K.

        Parameters
        ----------
        x : ndarray, shape (P, n)
        s : ndarray, shape (R,)
            Tustin's s, rad/s; not 0 where there is an integrator (inf and a warning of numpy).

        Returns
        -------
        ndarray, shape (P, R, U, Y)
            Command per error.
        """
        parts = self.split(x)
        _, E = self._resolvent(parts.log_w, parts.log_zeta, s)
        blocks = parts.C[:, None] @ (E @ parts.B[:, None])
        K = np.sum(blocks, axis=2) + parts.D[:, None]
        if self.integrates.size:
            integral_action = parts.C_0[:, None] / s[None, :, None, None]
            K[..., self.integrates] += integral_action
        return np.asarray(K)

    def slopes(self, x: Real, s: Complex, left: Complex, right: Complex) -> Complex:
        """Slopes of left^H K right in every parameter.

        Parameters
        ----------
        x : ndarray, shape (P, n)
        s : ndarray, shape (R,)
            Tustin's s, rad/s; not 0 where there is an integrator.
        left : ndarray, shape (P, R, U)
        right : ndarray, shape (P, R, Y)

        Returns
        -------
        ndarray, shape (P, R, n)
            Complex: left^H (dK/dx_i) right of each parameter x_i.
        """
        log_w, log_z, C, B, _, _ = self.split(x)
        ratio, E = self._resolvent(log_w, log_z, s)
        left_conjugate = np.conj(left)
        # Into a block, g = E B right, and back from it, h' = left^H C E; both (P, R, m, 2).
        inputs = B[:, None] @ right[:, :, None, :, None]
        g_columns = E @ inputs
        C_transposed = np.swapaxes(C, -1, -2)[:, None]
        outputs = C_transposed @ left_conjugate[:, :, None, :, None]
        h_columns = np.swapaxes(E, -1, -2) @ outputs
        g = g_columns[..., 0]
        h = h_columns[..., 0]
        # dE = -E d(s/w - M) E: by log w of s/w, by log zeta of the entry 2 zeta.
        in_w = ratio * np.sum(h * g, axis=-1)
        zeta = np.exp(log_z)[:, None, :]
        in_z = -2 * zeta * h[..., 1] * g[..., 1]
        # Free entries: what stands to the left of an entry times what stands to the right.
        block, actuator, state = self._c
        in_c = left_conjugate[:, :, actuator] * g[:, :, block, state]
        block, state, output = self._b
        in_b = h[:, :, block, state] * right[:, :, output]
        actuator, output = self._d
        in_d = left_conjugate[:, :, actuator] * right[:, :, output]
        actuator, integrator = self._i
        integrated = right[:, :, self.integrates[integrator]]
        in_i = left_conjugate[:, :, actuator] * integrated / s[None, :, None]
        return np.concatenate([in_w, in_z, in_c, in_b, in_d, in_i], axis=2)

    # State space

    def continuous(self, x: Real) -> tuple[Real, Real, Real, Real]:
        """Continuous state space of K(s).

        Parameters
        ----------
        x : ndarray, shape (n,)
            As `split` takes it; logarithms beyond 700 overflow, which `bounds` excludes.

        Returns
        -------
        A, B, C, D : ndarray, shapes (order, order), (order, Y), (U, order), (U, Y)
            Time in seconds. States: integrators, then two for each block.
        """
        parts = self._split_one(x)
        n_integrators = self.integrates.size
        w = np.exp(parts.log_w)
        zeta = np.exp(parts.log_zeta)
        A = np.zeros((self.order, self.order))
        B = np.zeros((self.order, self.outputs))
        C = np.zeros((self.inputs, self.order))
        for block in range(self.blocks):
            first = n_integrators + 2 * block
            states = slice(first, first + 2)
            M = np.array([[0, 1], [-1, -2 * zeta[block]]])
            A[states, states] = w[block] * M
            B[states] = w[block] * parts.B[block]
            C[:, states] = parts.C[block]
        B[np.arange(n_integrators), self.integrates] = 1.0
        C[:, :n_integrators] = parts.C_0
        return A, B, C, parts.D.copy()

    def discrete(self, x: Real) -> tuple[Real, Real, Real, Real]:
        """State space of K at the sampling time, by Tustin's rule: the values of K(s) at Tustin's s.

        Parameters
        ----------
        x : ndarray, shape (n,)
            As `split` takes it.

        Returns
        -------
        A, B, C, D : ndarray, shapes (order, order), (order, Y), (U, order), (U, Y)
            States as of `continuous`.
        """
        return tustin(*self.continuous(x), self.dt_s)


def tustin(A: Real, B: Real, C: Real, D: Real, dt_s: float) -> tuple[Real, Real, Real, Real]:
    """Discrete state space with the values of the continuous one at s = (2/dt) (z - 1)/(z + 1).

    Parameters
    ----------
    A, B, C, D : ndarray, shapes (n, n), (n, Y), (U, n), (U, Y)
        Continuous state space, time in seconds.
    dt_s : float
        Sampling period, seconds; positive (not checked).

    Returns
    -------
    A, B, C, D : ndarray
        Of the same shapes.

    Raises
    ------
    numpy.linalg.LinAlgError
        A pole at s = 2/dt, where z is infinite.
    """
    eye = np.eye(A.shape[0])
    half_step = A * dt_s / 2
    inverse = np.linalg.inv(eye - half_step)
    A_z = inverse @ (eye + half_step)
    B_z = inverse @ B * dt_s
    C_z = C @ inverse
    D_z = D + C @ inverse @ B * dt_s / 2
    return A_z, B_z, C_z, D_z


def _rectangles(pattern: Boolean, count: int) -> list[tuple[Boolean, Boolean]]:
    """Rows (U,) and columns (Y,) of K that each of `count` blocks belongs to, as masks.

    All of a full pattern (U, Y); else one actuator at a time, in turn, with the outputs that it may use. A
    pattern without any entry is a ZeroDivisionError, unless count is 0.
    """
    inputs, outputs = pattern.shape
    if pattern.all():
        return [(np.ones(inputs, bool), np.ones(outputs, bool))] * count
    used_rows = [row for row in range(inputs) if pattern[row].any()]
    rectangles = []
    for block in range(count):
        row = used_rows[block % len(used_rows)]
        rectangles.append((np.arange(inputs) == row, pattern[row]))
    return rectangles
