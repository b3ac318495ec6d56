"""GIF of the meshing pair, with the contact point and the force on rotor 2."""

import dataclasses
import io
import itertools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from numpy.typing import NDArray
from PIL import Image

from rootsopt.profiles import Profile, place_pair
from rootsopt.response.result import Series
from rootsopt.runtime.programs import CachedFunction
from rootsopt.view.figures.designs import draw_rotor
from rootsopt.view.figures.drawing import Drawing
from rootsopt.view.figures.force import plot_flank_force
from rootsopt.view.figures.pieces import polyline
from rootsopt.view.figures.style import BLUE, ORANGE, SKY, VERMILION, beside, figure

_MM = 1e3
_FRAMES = 40  # frames per mesh period
_MOST_PERIODS = 4
_MILLISECONDS = 60  # per frame
_DPI = 80
_COLORS = 64
_CHORD = 0.01  # chord of the drawn polygons, in outer radii
_ARROW = 0.75  # length of the longest arrow, in pitch radii
_FLANKS = ("drive flank", BLUE), ("coast flank", VERMILION)


@dataclasses.dataclass(frozen=True)
class Contacts:
    """Contacts at n rotations φ of rotor 1.

    `point` (n, 2): contact points (mm, fixed frame); `normal` (n, 2): unit normals from rotor 1 to
    rotor 2; `present` (n,): mask of the rotations at which the flanks are in contact.
    """

    point: NDArray[np.float64]
    normal: NDArray[np.float64]
    present: NDArray[np.bool_]


@CachedFunction
def _rolling(profile, roll):
    """Return (pressure angles (rad), signed distances from the pitch point (m)) of contacts.

    `roll` (n,): roll angles (rad) of the contacts on the flank."""
    half = profile.half_pitch
    beyond = roll > half
    point = profile.addendum(profile.normal_at(jnp.where(beyond, 2 * half - roll, roll)))
    return point.psi, jnp.where(beyond, -point.s, point.s)


def rolling_contacts(
    profile: Profile, rotation: Float[np.ndarray, " n"], coast: bool = False
) -> Contacts:
    """Return the contacts of two rotors with this `profile` in perfect rolling.

    `rotation` (n,): rotations φ of rotor 1 (rad); `coast`: whether the contacts are those of the
    coast flanks, not of the drive flanks. A drive flank is in contact while its roll angle β = -φ
    is between 0 and π/N, once in every lobe pitch. At other rotations, the result holds the contact
    at the nearer end of this range, marked as not present. The contact point is (r + s sin ψ, s cos
    ψ), and the normal is (sin ψ, cos ψ). Here, r is the pitch radius, ψ the pressure angle, and s
    the distance from the pitch point. The contact of a coast flank is the mirror image in the line
    of centres, with β = φ."""
    half = np.pi / (2 * profile.lobes)
    roll = (rotation if coast else -rotation) - half
    roll = half + roll - 4 * half * np.round(roll / (4 * half))
    psi, s = map(np.asarray, _rolling(profile, jnp.asarray(np.clip(roll, 0, 2 * half))))
    normal = np.stack([np.sin(psi), np.cos(psi) * (-1 if coast else 1)], axis=-1)
    point = _MM * (s[:, None] * normal + [float(profile.pitch_radius), 0.0])
    return Contacts(point, normal, (roll >= 0) & (roll <= 2 * half))


@dataclasses.dataclass(frozen=True)
class Frames:
    """Frames of a motion, evenly spaced.

    `time` (n,): time (s); `rotation`, `relative` (n,): rotation of rotor 1 and ε (rad); `flanks`:
    contacts of the drive and of the coast flanks; `forces`: largest force (N) on drive and coast
    flank in the time interval of each frame, (n,) each, None in perfect rolling; `samples`: number
    of samples of the motion that the frames cover.
    """

    time: NDArray[np.float64]
    rotation: NDArray[np.float64]
    relative: NDArray[np.float64]
    flanks: tuple[Contacts, Contacts]
    forces: tuple[NDArray[np.float64], NDArray[np.float64]] | None
    samples: int


def frames_of(profile: Profile, series: Series | None = None, periods: int = 1) -> Frames:
    """Return the frames of a motion over `periods` mesh periods, or of perfect rolling over one.

    `periods` is limited to 4 and to the length of `series`. In perfect rolling, where one flank
    takes over from the other, both ends touch; only one of them is present."""
    pitch = 2 * np.pi / profile.lobes
    if series is None:
        rotation = pitch * np.arange(_FRAMES) / _FRAMES
        drive, coast = _both(profile, rotation)
        coast = dataclasses.replace(coast, present=coast.present & ~drive.present)
        return Frames(0 * rotation, rotation, 0 * rotation, (drive, coast), None, 0)
    whole = max(1, round(float(np.ptp(series.rotation)) / pitch))
    periods = max(1, min(periods, whole, _MOST_PERIODS))
    samples = len(series.time) * periods // whole
    edges = np.linspace(0, samples, periods * _FRAMES + 1).astype(int)
    middle = (edges[1:] + edges[:-1]) // 2
    drive, coast = (
        np.array([np.max(force[a : max(b, a + 1)]) for a, b in itertools.pairwise(edges)])
        for force in (series.drive_force, series.coast_force)
    )
    rotation = series.rotation[middle]
    return Frames(series.time[middle], rotation, series.relative[middle],
                  _both(profile, rotation), (drive, coast), samples)  # fmt: skip


def _both(profile: Profile, rotation: NDArray[np.float64]) -> tuple[Contacts, Contacts]:
    return rolling_contacts(profile, rotation), rolling_contacts(profile, rotation, coast=True)


def meshing_gif(
    drawing: Drawing, profile: Profile, series: Series | None = None, periods: int = 1
) -> bytes:
    """Return the content of a GIF of the meshing pair.

    `drawing`, `profile`: drawing and profile of the rotor; `series`, `periods`: as in `frames_of`.
    An arrow's length is proportional to the largest force in the time interval of its frame, and a
    graph shows the force. In perfect rolling, arrows show the direction of the force alone, because
    only a simulation can give its size.
    """
    frames = frames_of(profile, series, periods)
    rows = 1 if series is None else 2
    made, axes = figure(9, 5.4 + 2 * (rows - 1), rows, 1, grid=False, height_ratios=[2.6, 1][:rows])
    scene = _Scene(axes[0, 0], drawing)
    axes[0, 0].set_title(
        "Perfect rolling: contact and direction of its force on rotor 2"
        if series is None
        else "Contact force on rotor 2; the arrow's length shows the force below"
    )
    cursor = None if series is None else _force_panel(axes[1, 0], series, frames.samples)
    degrees = np.degrees(frames.rotation - frames.rotation[0])
    # In perfect rolling, every contact has an arrow of the same length.
    forces = frames.forces or [flank.present.astype(float) for flank in frames.flanks]
    longest = max(1e-30, *map(np.max, forces))

    def draw(i: int) -> None:
        scene.turn(frames.rotation[i], frames.rotation[i] + frames.relative[i])
        for arrow, flank, force in zip(scene.arrows, frames.flanks, forces, strict=True):
            arrow.show(flank.point[i], flank.normal[i], float(force[i] / longest))
        if cursor is not None:
            cursor.set_xdata([degrees[i], degrees[i]])

    return _gif(made, draw, len(degrees))


def _force_panel(ax: Axes, series: Series, samples: int):
    """Draw the flank forces over the rotation on `ax`; return the line that marks a rotation.

    `samples`: number of samples of `series` that are drawn."""
    degrees = np.degrees(series.rotation[:samples] - series.rotation[0])
    forces = series.drive_force[:samples], series.coast_force[:samples]
    for (name, color), force in zip(_FLANKS, forces, strict=True):
        plot_flank_force(ax, degrees, force, color, name)
    top = max(map(np.max, forces))
    ax.set(
        xlim=(0, degrees[-1]),
        ylim=(0, 1.1 * top if top > 0 else 1),
        xlabel="rotation of rotor 1 (°)",
        ylabel="contact force (N)",
    )
    beside(ax)
    return ax.axvline(0, color="black", linewidth=1.0)


class _Arrow:
    """Draws the contact point of the drive or coast flanks, and an arrow for its force."""

    def __init__(self, ax: Axes, color: str, longest: float):
        self.longest = longest
        (self.point,) = ax.plot([], [], "o", color=color, markersize=6, zorder=5)
        self.arrow = ax.annotate(
            "",
            (0, 0),
            (0, 0),
            arrowprops={"arrowstyle": "-|>,head_width=.35,head_length=.7", "color": color,
                        "linewidth": 2.2, "shrinkA": 0, "shrinkB": 0},
            zorder=6,
        )  # fmt: skip

    def show(self, point, normal, share: float) -> None:
        """Show the arrow at `point` (mm) in the direction of `normal`.

        `share`: length as a fraction of the longest arrow; 0 hides the arrow and its point."""
        self.point.set_data([point[0]], [point[1]])
        for artist in (self.point, self.arrow):
            artist.set_visible(share > 0)
        self.arrow.set_position(tuple(point))
        self.arrow.xy = tuple(point + self.longest * share * np.asarray(normal))


class _Scene:
    """Matplotlib axes with both rotors; call `turn` for each frame."""

    def __init__(self, ax: Axes, drawing: Drawing):
        points = polyline(drawing.pieces, _CHORD * drawing.outer_radius)
        self.outline = np.stack([np.real(points), np.imag(points)], axis=-1)
        self.lobes, self.center = drawing.lobes, 2 * drawing.pitch_radius
        hole = 0.0 if drawing.bore is None else drawing.bore / 2
        self.rotors = []
        for name, color, x in (("rotor 1 ↺", SKY, 0.0), ("rotor 2 ↻", ORANGE, self.center)):
            self.rotors.append(draw_rotor(ax, self.outline, color, x, drawing.pitch_radius))
            ax.add_patch(Circle((x, 0), hole, facecolor="white", edgecolor="black"))
            ax.annotate(name, (x, -hole), (0, -16), textcoords="offset points", ha="center")
        for name, color in _FLANKS:
            ax.plot([], [], "o", color=color, label=name)
        self.label = ax.text(0.01, 0.98, "", transform=ax.transAxes, va="top")
        reach = 1.06 * drawing.outer_radius
        ax.set(
            xlim=(-reach, self.center + reach),
            ylim=(-reach, reach),
            xlabel="x (mm)",
            ylabel="y (mm)",
            aspect="equal",
        )
        ax.legend(loc="lower left", fontsize="small", framealpha=0.9)
        self.arrows = [_Arrow(ax, color, _ARROW * drawing.pitch_radius) for _, color in _FLANKS]

    def turn(self, first: float, second: float) -> None:
        """Turn rotor 1 to the angle `first` and rotor 2 to the angle `second` (rad)."""
        placed = place_pair(self.outline, self.lobes, self.center, first, second)
        for rotor, points in zip(self.rotors, placed, strict=True):
            rotor.set_verts([points])
        pitch = 360 / self.lobes
        self.label.set_text(f"φ = {np.degrees(first) % pitch:5.1f}° of {pitch:g}°")


def _gif(made: Figure, draw, count: int) -> bytes:
    """Return the content of a GIF that repeats frames 0 to `count` - 1 endlessly.

    `draw`: function that draws the frame with a given number. All frames share one palette."""
    made.set_dpi(_DPI)
    canvas = FigureCanvasAgg(made)
    pictures: list[Image.Image] = []
    for i in range(count):
        draw(i)
        canvas.draw()
        if i == 0:
            made.set_layout_engine("none")  # laid out once, so that nothing moves
        pictures.append(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"))
    # A few frames side by side contain all the colours.
    some = np.hstack([np.asarray(picture) for picture in pictures[:: max(1, count // 8)]])
    palette = Image.fromarray(some).quantize(_COLORS, Image.Quantize.MAXCOVERAGE)
    frames = [one.quantize(palette=palette, dither=Image.Dither.NONE) for one in pictures]
    file = io.BytesIO()
    frames[0].save(
        file, format="GIF", duration=_MILLISECONDS,
        save_all=True, append_images=frames[1:], loop=0, optimize=True,
    )  # fmt: skip
    return file.getvalue()
