"""The motion of a rotor pair and its force against a model that shares no code with the package.

The reference is written from the specification alone, in NumPy and SciPy. It has its own outlines,
gap by nearest points, contact law, timing gear and load."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import RectBivariateSpline
from scipy.spatial import cKDTree

from rootsopt.config import load
from rootsopt.scene import outline_mm
from tests.dynamics.test_dynamics import integrator, pair_of, run_period, run_strobe, statistics

R, LOBES = 0.033, 3
MESH = 2 * np.pi / LOBES
PERIODS = 10
UNROUNDED = "contact.smoothing_mm=0"
"""The law as it stands, without a rounding of its corners."""
CONFIGS = ("cic_drawn", pytest.param("ee", marks=pytest.mark.long))


def flank_points(profile, points):
    """Return points of half a lobe (complex, m) and their outward unit normals.

    They come from the paper's Eqs. 1, 2 and 7 in roll-angle form."""
    half = np.pi / (2 * LOBES)
    if profile.family == "ee":
        beta = np.linspace(0, half, 2 * points)
        psi = LOBES * (half - beta)
        pieces = [(beta, psi, R / LOBES * np.sin(psi))]
    else:
        alpha, tip = np.radians([profile.pressure_angle_deg, profile.tip_arc_angle_deg])
        start = half - profile.involute_length_mm * 1e-3 / (R * np.sin(alpha))
        beta = np.linspace(start, half, points)
        involute = beta, np.full(points, alpha), R * np.cos(alpha) * (half - beta)
        # The arc is tangent to the involute's end; its centre lies on the ray `tip`.
        end = np.exp(1j * start) * (R + involute[2][0] * 1j * np.exp(-1j * alpha))
        normal = start + np.pi / 2 - alpha
        radius = (end * np.exp(-1j * tip)).imag / np.sin(normal - tip)
        center = end - radius * np.exp(1j * normal)
        # In contact its normal passes through the pitch point.
        nu = np.linspace(tip, normal, points)
        along = (center * np.exp(-1j * nu)).real
        reach = -along + np.sqrt(along**2 - abs(center) ** 2 + R**2)
        beta = np.angle(center + reach * np.exp(1j * nu))
        arc = beta, beta + np.pi / 2 - nu, radius - reach
        height = abs(center) + radius - R
        land = np.linspace(0, tip, points), np.full(points, np.pi / 2), np.full(points, height)
        pieces = [land, arc, involute]
    beta, psi, s = (np.concatenate([p[i][k > 0 :] for k, p in enumerate(pieces)]) for i in range(3))
    beta = np.concatenate([beta, (np.pi / LOBES - beta)[-2::-1]])
    psi, s = np.concatenate([psi, psi[-2::-1]]), np.concatenate([s, -s[-2::-1]])
    place = np.exp(1j * beta) * (R + s * np.sin(psi) + 1j * s * np.cos(psi))
    return place, np.exp(1j * (beta + np.pi / 2 - psi))


class Rotors:
    """Two rotors as closed curves of nodes with normals, joined by cubics."""

    STRIDE = 20

    def __init__(self, config, points=300):
        turn = np.exp(1j * MESH)
        closed = [
            np.outer(turn ** np.arange(LOBES), [*z[:-1], *(z.conj() * turn)[:0:-1]]).ravel()
            for z in flank_points(config.profile, points)
        ]
        self.nodes, self.normals = closed
        self.tree = cKDTree(np.stack([self.nodes.real, self.nodes.imag], -1))
        z = np.append(self.nodes, self.nodes[0])
        # ∫r² dA over triangles to the centre.
        cross = (z[:-1].conj() * z[1:]).imag
        square = abs(z[:-1]) ** 2 + (z[:-1].conj() * z[1:]).real + abs(z[1:]) ** 2
        moment = np.sum(cross * square) / 12
        self.inertia = config.rotor.density_kg_m3 * config.rotor.length_mm * 1e-3 * moment

    def cubic(self, a):
        """Return the curve from node `a` to the next: start, chord, and coefficients."""
        b = (a + 1) % len(self.nodes)
        chord = self.nodes[b] - self.nodes[a]
        m0, m1 = (1j * self.normals[i] * abs(chord) for i in (a, b))
        return self.nodes[a], chord, m0, 3 * chord - 2 * m0 - m1, m0 + m1 - 2 * chord

    def distance(self, w, refine=True):
        """Return the signed distance of points `w` (rotor frame) from the outline, negative
        inside."""
        nearest = self.tree.query(np.stack([w.real, w.imag], -1))[1]
        if not refine:
            return ((w - self.nodes[nearest]) * self.normals[nearest].conj()).real
        best = np.full(w.shape, np.inf)
        for shift in (-1, 0):
            start, chord, m0, c2, c3 = self.cubic(nearest + shift)
            t = np.clip(((w - start) / chord).real, 0, 1)
            for step in range(5):
                off = w - start - t * (m0 + t * (c2 + t * c3))
                slope = m0 + t * (2 * c2 + 3 * t * c3)
                if step < 4:
                    descent = abs(slope) ** 2 - (off * (2 * c2 + 6 * t * c3).conj()).real
                    t = np.clip(t + (off * slope.conj()).real / descent, 0, 1)
            signed = np.copysign(abs(off), -(slope.conj() * off).imag)
            best = np.where(abs(signed) < abs(best), signed, best)
        return best

    def gap(self, phi, relative):
        """Return the least signed distance (m) for one φ1 and an array of ε."""
        turn1 = np.exp(1j * phi)
        turn2 = np.exp(-1j * (phi + relative + np.pi / LOBES))
        count = len(self.nodes)
        coarse = np.arange(0, count, self.STRIDE)
        coarse = coarse[abs(self.nodes[coarse] * turn1 - 2 * R) < 1.001 * abs(self.nodes).max()]

        def in_second(first, turn2):
            return (2 * R - first * turn1).conj() * turn2

        far = self.distance(in_second(self.nodes[coarse][:, None], turn2), refine=False)
        around = np.arange(-self.STRIDE, self.STRIDE + 1)[:, None]
        index = (coarse[np.argmin(far, axis=0)] + around) % count
        near = self.distance(in_second(self.nodes[index], turn2))
        # Between the nodes on both sides of the deepest one, along rotor 1's own cubic.
        pick = np.clip(np.argmin(near, axis=0), 1, 2 * self.STRIDE - 1), np.arange(len(relative))
        t = np.linspace(0, 1, 13)[:, None]
        sides = []
        for a in ((index[pick] - 1) % count, index[pick]):
            start, _, m0, c2, c3 = self.cubic(a)
            sides.append(start + t * (m0 + t * (c2 + t * c3)))
        placed = in_second(np.concatenate([sides[0][:-1], sides[1]]), turn2)
        found = self.distance(placed)
        # Vertex of the parabola through the three best.
        best = np.clip(np.argmin(found, axis=0), 1, len(found) - 2)
        pick = best + np.arange(-1, 2)[:, None], pick[1]
        before, after = abs(np.diff(placed[pick], axis=0))
        d0, d1, d2 = found[pick]
        left, right = (d1 - d0) / before, (d2 - d1) / after
        bend = (right - left) / (before + after)
        tilt = (left * after + right * before) / (before + after)
        inside = abs(tilt) < 2 * bend * np.maximum(before, after)
        return np.where(inside, d1 - tilt**2 / (4 * np.where(inside, bend, 1.0)), found.min(axis=0))

    def map(self, deepest, columns, rows=12):
        """Return a spline of the gap over (φ1, ε) for each sign of ε: {-1: drive, +1: coast}."""
        t = np.linspace(-0.12, MESH + 0.12, columns)
        # Where one flank hands over to the next (φ1 = 0 and half a mesh period) the gap
        # bends most.
        phi = t - 0.7 * np.sin(2 * LOBES * t) / (2 * LOBES)
        splines = {}
        for side in (-1, 1):
            relative = np.linspace(0, deepest, rows)
            values = np.array([self.gap(p, side * relative) for p in phi])
            if side < 0:
                splines[side] = RectBivariateSpline(phi, -relative[::-1], values[:, ::-1])
            else:
                splines[side] = RectBivariateSpline(phi, relative, values)
        return splines


class Reference:
    """The scene of a config in SI units, as DESIGN.md words it."""

    def __init__(self, config, columns=200, deepest=4e-3):
        contact, scene, gear = config.contact, config.scene, config.scene.timing_gear
        assert contact.smoothing_mm == 0
        self.rotors = Rotors(config)
        self.splines = self.rotors.map(deepest, columns)
        self.inertia = self.rotors.inertia
        self.exponent = contact.exponent
        self.stiffness = contact.stiffness_N_per_mm_e * 1e3**contact.exponent
        self.damping = contact.max_damping_N_s_per_mm * 1e3
        self.full = contact.full_damping_depth_mm * 1e-3
        self.clearance = contact.clearance_mm * 1e-3
        self.speed = scene.speed_rpm * 2 * np.pi / 60
        self.load = scene.load.torque_N_m
        self.gear_stiffness = gear.stiffness_N_m_per_rad
        self.play = gear.backlash_mm * 1e-3 / (2 * R)
        self.gear_damping = 2 * gear.damping_ratio * np.sqrt(self.gear_stiffness * self.inertia / 2)
        self.deepest = deepest
        self.period = MESH / self.speed

    def force(self, time, relative, rate):
        """Return the contact force (N) and its torque on rotor 2 (N·m)."""
        assert np.all(abs(relative) < self.deepest)
        spline = self.splines[-1 if relative < 0 else 1]
        phi = self.speed * time % MESH
        depth = -spline(phi, relative, grid=False) - self.clearance
        if depth <= 0:
            return 0.0, 0.0
        by_phi = spline(phi, relative, dx=1, grid=False)
        by_relative = spline(phi, relative, dy=1, grid=False)
        closing = -by_phi * self.speed - by_relative * rate
        x = min(depth / self.full, 1.0)
        damped = self.damping * (3 * x**2 - 2 * x**3) * closing
        force = max(0.0, self.stiffness * depth**self.exponent + damped)
        return force, force * by_relative

    def slope(self, time, state):
        """Return the time derivatives of (ε, dε/dt, ∫F dt, ∫F² dt)."""
        relative, rate = state[:2]
        force, torque = self.force(time, relative, rate)
        torque -= self.load
        excess = abs(relative) - self.play
        if excess > 0:
            torque -= self.gear_stiffness * np.sign(relative) * excess + self.gear_damping * rate
        return [rate, torque / self.inertia, force, force**2]

    def run(self, periods, rtol=1e-9):
        """Return stroboscopic states, and (mean, peak, RMS) of the last period."""
        state, states = np.zeros(4), []
        for k in range(periods):
            last = k == periods - 1
            state[2:] = 0
            solution = solve_ivp(
                self.slope,
                (k * self.period, (k + 1) * self.period),
                state,
                "DOP853",
                rtol=rtol,
                atol=rtol * np.array([1e-3, 1.0, 0.1, 10.0]),
                max_step=self.period / 20,
                dense_output=last,
            )
            state = solution.y[:, -1]
            states.append(state[:2])
        times = np.linspace(solution.t[0], solution.t[-1], 4001)
        forces = [
            self.force(t, *y[:2])[0] for t, y in zip(times, solution.sol(times).T, strict=True)
        ]
        mean, square = state[2:] / self.period
        return np.array(states), np.array([mean, max(forces), np.sqrt(square)])


@functools.cache
def reference_of(name):
    """Return the reference of a config, its stroboscopic states, and mean, peak and RMS force."""
    reference = Reference(load(f"configs/{name}.yaml", [UNROUNDED]))
    return reference, *reference.run(PERIODS)


# Between 200 and 400 columns the reference itself moves by 6e-5 (CIC: its gap has a corner
# where the land begins, which a spline rounds) and 1e-6 (EE).
REACH = {"cic_drawn": (2e-4, 1e-3, 1e-3), "ee": (1e-5, 1e-4, 2e-4)}


@pytest.mark.parametrize("name", CONFIGS)
def test_motion_and_force_are_those_of_an_independent_integration(name):
    """From ε = 0, stroboscopic states and mean, RMS and peak force agree with SciPy's."""
    pair, _ = pair_of(f"configs/{name}.yaml", [UNROUNDED])
    reference, states, (mean, peak, rms) = reference_of(name)
    average, extreme, state = REACH[name]
    scale = float(pair.angle_scale)
    expected = states * [1 / scale, reference.period / scale]
    found = run_strobe(pair, jnp.zeros(2), PERIODS, integrator())
    assert bool(found.solved)
    # Otherwise, two pairs at rest would agree as well.
    assert np.ptp(expected[:3, 0]) > 10 * state or np.ptp(expected[:3, 1]) > 10 * state
    np.testing.assert_allclose(found.states, expected, rtol=0, atol=state * np.ptp(expected))
    orbit = run_period(pair, found.states[-1], integrator())
    got = statistics(orbit)
    np.testing.assert_allclose(got[[0, 2]], [mean, rms], rtol=average)
    np.testing.assert_allclose(got[1], peak, rtol=extreme)


@pytest.mark.parametrize("name", CONFIGS)
def test_outline_and_inertia_of_the_reference_are_those_of_the_package(name):
    """The reference's own outline passes through the exported one; its inertia agrees."""
    pair, config = pair_of(f"configs/{name}.yaml")
    rotors = reference_of(name)[0].rotors
    points = outline_mm(config)[:-1] @ [1e-3, 1e-3j]
    assert np.max(abs(rotors.distance(points))) < 1e-11
    # Inscribed polygon: chord error of second order in the node spacing.
    assert float(pair.inertia) == pytest.approx(rotors.inertia, rel=1e-5)
