"""Two rotors in the plane, written from Newton's laws with NumPy and without the package.

Every body has three coordinates. Contact is a pair of points on two curves, and forces are vectors
that act there. State: φ1, φ2 (rad, each in its own sense of rotation), the displacements x1, y1,
x2, y2 of the axes (m), then the six rates; time in seconds. The laws are those of DESIGN.md."""

from collections import namedtuple

import numpy as np

NODES = 72
"""Number of points of a flank at which the distances are first computed."""
STEPS = 1e-6 * np.eye(2)
BESIDE = np.array(np.meshgrid([0, -1, 1], [0, -1, 1])).reshape(2, 9).T


def cross(a, b):
    return (np.conjugate(a) * b).imag


def dot(a, b):
    return (np.conjugate(a) * b).real


class Flank:
    """Describe half a lobe of a CIC or EE rotor, with its tip on the real axis.

    The parameter p runs from 0 (tip) to `end` (root), through one smooth piece from each whole
    number to the next. A point is exp(iβ) (r + s sin ψ + i s cos ψ), its outward normal exp(i (β +
    π/2 - ψ))."""

    def __init__(self, profile):
        n, r = profile.lobes, profile.pitch_radius_mm * 1e-3
        half = np.pi / (2 * n)
        self.lobes, self.radius = n, r
        if profile.family == "ee":

            def epicycloid(t):
                angle = n * half * (1 - t)
                return half * t, angle, r / n * np.sin(angle)

            self.pieces = [epicycloid]
        else:
            alpha, tip = np.radians([profile.pressure_angle_deg, profile.tip_arc_angle_deg])
            start = half - profile.involute_length_mm * 1e-3 / (r * np.sin(alpha))
            length = r * np.cos(alpha) * (half - start)
            end = np.exp(1j * start) * (r + 1j * length * np.exp(-1j * alpha))
            normal = start + np.pi / 2 - alpha
            radius = (end * np.exp(-1j * tip)).imag / np.sin(normal - tip)
            center = end - radius * np.exp(1j * normal)

            def land(t):
                return tip * t, np.pi / 2, abs(center) + radius - r

            def arc(t):
                # In contact its normal passes through the pitch point.
                nu = tip + (normal - tip) * t
                along = dot(center, np.exp(1j * nu))
                reach = -along + np.sqrt(along**2 - abs(center) ** 2 + r**2)
                beta = np.angle(center + reach * np.exp(1j * nu))
                return beta, beta + np.pi / 2 - nu, radius - reach

            def involute(t):
                beta = start + (half - start) * t
                return beta, alpha, r * np.cos(alpha) * (half - beta)

            self.pieces = [land, arc, involute]
        self.end = 2 * len(self.pieces)
        places = (np.arange(2 * NODES) + 0.5) * self.end / (2 * NODES)
        self.nodes = places, *np.array([self(p, int(p)) for p in places]).T

    def __call__(self, p, number):
        """Return the point and the outward normal at p, on piece `number` or its continuation."""
        if number < len(self.pieces):
            beta, psi, s = self.pieces[number](p - number)
        else:
            # The dedendum meshes with the addendum in reverse.
            mate = self.end - 1 - number
            beta, psi, s = self.pieces[mate](self.end - p - mate)
            beta, s = np.pi / self.lobes - beta, -s
        turn = np.exp(1j * beta)
        place = self.radius + s * np.sin(psi) + 1j * s * np.cos(psi)
        return turn * place, turn * np.exp(1j * (np.pi / 2 - psi))


# A closest approach: a point on each rotor, the normal from rotor 1 to rotor 2, the gap.
Touch = namedtuple("Touch", "first second normal gap")


class Planar:
    """The equations of motion of a config's scene, which has all parts.

    `inertia` (kg·m²) and `mass` (kg) are those of a rotor, `load` a function from φ1 to the torques
    against the rotors."""

    def __init__(self, config, inertia, mass, load):
        self.scene, self.law = config.scene, config.contact
        self.flank = Flank(config.profile)
        self.radius, self.lobes = self.flank.radius, self.flank.lobes
        self.inertia, self.mass, self.load = inertia, mass, load
        self.distance = 2 * self.radius + 1e-3 * self.scene.center_distance_error_mm
        self.rounding, self.clearance = 1e-3 * self.law.smoothing_mm, 1e-3 * self.law.clearance_mm

    def ramp(self, x, width):
        """Return max(0, x), rounded over `width`."""
        if x <= 0:
            return 0.0
        return x if x >= width else 2 * x**2 / width - x**3 / width**2

    def normal_force(self, depth, closing):
        delta = self.ramp(depth, self.rounding)
        if delta == 0:
            return 0.0
        full = self.law.full_damping_depth_mm * 1e-3
        x = min(delta / full, 1.0)
        spring = self.law.stiffness_N_per_mm_e * (1e3 * delta) ** self.law.exponent
        damping = 1e3 * self.law.max_damping_N_s_per_mm * (3 * x**2 - 2 * x**3)
        return spring * self.ramp(1 + damping * closing / spring, min(self.rounding / full, 1.0))

    def coefficient(self, sliding):
        law = self.law.friction
        low, high = 1e-3 * law.stiction_speed_mm_s, 1e-3 * law.friction_speed_mm_s

        def step(x, x0, h0, x1, h1):
            t = np.clip((x - x0) / (x1 - x0), 0, 1)
            return h0 + (h1 - h0) * t**2 * (3 - 2 * t)

        if abs(sliding) < low:
            return step(sliding, -low, -law.static, low, law.static)
        return np.sign(sliding) * step(abs(sliding), low, law.static, high, law.kinetic)

    def touch(self, side, angles, axes):
        """Return the closest approach of the flanks nearest to the pitch point, or None.

        They are the leading flanks of rotor 1 (`side` 1) and the trailing ones of rotor 2, or the
        other way round."""
        lobes = np.exp(2j * np.pi * np.arange(self.lobes) / self.lobes)
        crossing = np.exp(0.5j * np.pi / self.lobes) * self.radius
        # In the rotors' own frames a leading flank lies ahead of the lobe's axis.
        turn1 = np.exp(1j * angles[0]) * lobes
        at1 = axes[0] + turn1 * (crossing if side > 0 else np.conjugate(crossing))
        lobe = np.argmin(abs(at1 - axes[0] - self.radius))
        turn1 = turn1[lobe]
        # Rotor 2 is the mirror image, with a valley towards rotor 1 at angle 0.
        turn2 = np.exp(1j * (angles[1] + np.pi / self.lobes)) * lobes
        at2 = axes[1] - np.conjugate(turn2 * (np.conjugate(crossing) if side > 0 else crossing))
        turn2 = turn2[np.argmin(abs(at2 - at1[lobe]))]

        def first(z):
            return turn1 * (z if side > 0 else np.conjugate(z))

        def second(z):
            return -np.conjugate(turn2 * (np.conjugate(z) if side > 0 else z))

        places, nodes, normals = self.flank.nodes
        z1, z2 = axes[0] + first(nodes), axes[1] + second(nodes)
        nearest = np.argmin(abs(z1[:, None] - z2[None, :]), axis=1)
        apart, n2 = z1 - z2[nearest], second(normals)[nearest]
        signed = np.where(abs(cross(n2, apart)) > 0.05 * self.radius, np.inf, dot(n2, apart))
        # Each local minimum along rotor 1 may be the least distance; far ones do not touch.
        around = np.pad(signed, 1, constant_values=np.inf)
        dips = (signed <= around[:-2]) & (signed <= around[2:])
        dips &= signed < self.clearance + 5e-4 * self.radius

        def at(p, pieces):
            (a, m), (b, n) = self.flank(p[0], pieces[0]), self.flank(p[1], pieces[1])
            a, m, b, n = axes[0] + first(a), first(m), axes[1] + second(b), second(n)
            return Touch(a, b, m, dot(m, b - a)), np.array([cross(m, -n), cross(m, b - a) / 1e-2])

        # Each pair of pieces by itself, continued beyond its ends.
        found = []
        for dip in np.flatnonzero(dips):
            guess = np.array([places[dip], places[nearest[dip]]])
            for pieces in np.floor(guess).astype(int) + BESIDE:
                if np.any(pieces < 0) or np.any(pieces >= self.flank.end):
                    continue
                p = np.clip(guess, pieces, pieces + 1)
                for _ in range(30):
                    touch, miss = at(p, pieces)
                    slopes = [(at(p + h, pieces)[1] - at(p - h, pieces)[1]) / 2e-6 for h in STEPS]
                    step = np.linalg.solve(np.array(slopes).T, -miss)
                    p = p + step
                    if not np.all(abs(p - pieces) < 3) or np.max(abs(step)) < 1e-10:
                        break
                # The tip may lean over to its other flank; the root it touches is this one.
                first_end = np.where(pieces == 0, -1, pieces)
                inside = np.all((p >= first_end - 1e-9) & (p <= pieces + 1 + 1e-9))
                # A common normal where the distance is least, not greatest.
                least = np.linalg.det(np.array(slopes)) > 0
                # Through a sharp edge the nearest point is another one.
                through = min(np.min(abs(touch.first - z2)), np.min(abs(touch.second - z1)))
                least &= through > 0.98 * abs(touch.gap)
                if inside and least and abs(touch.gap - signed[dip]) < 5e-4 * self.radius:
                    found.append(touch)
        return min(found, key=lambda touch: touch.gap, default=None)

    def forces(self, state):
        """Return torques on the rotors, forces on their axes and contact force."""
        axes = np.array([0, self.distance]) + state[2:6:2] + 1j * state[3:6:2]
        (speed1, speed2), moving = state[6:8], state[8:12:2] + 1j * state[9:12:2]
        torques, pushes, total = np.zeros(2), np.zeros(2, complex), 0.0
        # Of the drive flanks and of the coast flanks, where they exist.
        for touch in filter(None, [self.touch(side, state[:2], axes) for side in (1, -1)]):
            arm1, arm2 = touch.first - axes[0], touch.second - axes[1]
            slip = moving[0] + 1j * speed1 * arm1 - moving[1] + 1j * speed2 * arm2
            depth = -touch.gap - self.clearance
            normal = self.normal_force(depth, dot(touch.normal, slip))
            along = 1j * touch.normal
            force = normal * (touch.normal + self.coefficient(dot(along, slip)) * along)
            torques += cross(arm1, -force), -cross(arm2, force)
            pushes += [-force, force]
            total += normal
        return torques, pushes, total

    def __call__(self, time, state):
        """Return d(state)/dt."""
        torques, pushes, _ = self.forces(state)
        torques = torques - np.array(self.load(state[0]))
        gear, motor, supports = self.scene.timing_gear, self.scene.motor, self.scene.supports
        aside = state[1] - state[0] - 1e-3 * self.scene.phase_error_mrad
        excess = abs(aside) - 1e-3 * gear.backlash_mm / (2 * self.radius)
        width = self.rounding / self.radius
        t = np.clip(excess / width, 0, 1)
        # Cubic roundings, and as much of t² (1 - t)² as restores the integral.
        bump = t**2 * (1 - t) ** 2
        taken_up = self.ramp(excess, width) + 2.5 * width * bump
        hold = gear.stiffness_N_m_per_rad * np.sign(aside) * taken_up
        damping = 2 * gear.damping_ratio * np.sqrt(gear.stiffness_N_m_per_rad * self.inertia / 2)
        hold += damping * (t**2 * (3 - 2 * t) + 15 * bump) * (state[7] - state[6])
        slip = state[6] - self.scene.speed_rpm * 2 * np.pi / 60
        drive = motor.torque_N_m - motor.slope_N_m_s_per_rad * slip
        first = (torques[0] + hold + drive) / (self.inertia + motor.inertia_kg_m2)
        along = np.stack([pushes.real, pushes.imag], axis=1).ravel()
        along -= 1e3 * supports.stiffness_N_per_mm * state[2:6]
        along -= 1e3 * supports.damping_N_s_per_mm * state[8:12]
        second = (torques[1] - hold) / self.inertia
        return np.concatenate([state[6:], [first, second], along / self.mass])
