"""The least time of each stage on a machine: what it must read, compute and write, over what the machine can do.

    processor   sum over kinds of work of amount / rate: decoding, arithmetic, rays and hashing share the same cores
    floor       the largest of processor, memory moved / bandwidth, and disk: all three can go on at once (roofline)

Numbers of photos, pixels, rays, samples, texels, faces and bytes are counted (floor_counts.py) or are constants of the
code. The constants below are estimates of the arithmetic for one of them, good to a factor of two or three. Work that
a better algorithm would not need (a second decoding, several solves of one system, start-up) is not in a floor.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields

from workflows.bench.floor_counts import Counts
from workflows.bench.machine_rates import Rates

# ------------------------------------------------------------------ estimates: operations for one ...
PIXEL_CHECKED = 60  # pixel of a new photo: grey, blur, clipping, sharpness, structure
PIXEL_FEATURES = 1700  # pixel for SIFT: five octaves of six blurs of 2 x 13 taps, the first one at twice the size
DESCRIPTOR = 128  # numbers of a descriptor
FACE_NETWORKS = 0.4e9  # photo: detection and 468 landmarks, as matrix products
PERSON_NETWORK = 4 * 0.25e9  # photo: the person network sees it four times
PIXEL_KEYED, PIXEL_CUT = 60, 6000  # pixel keyed; pixel of a person's mask: GrabCut's iterations and a minimum cut
FLAT = 30  # pixels of a mask, nearly all black or white, compressed in the time of one of a picture
VOXEL_VIEW = 25  # voxel of the hull in one view: projection and look-up
SPLINE, SPLINE_VALUE = 27 * 2 * 4 + 40, 27 * 2 + 30  # SDF with its gradient; its value alone
BACKWARD = 3  # forward and backward pass over a forward pass
MARCH = 12  # evaluations of the SDF on a ray until the surface
CORNER = 8 * 2 * 2 + 12  # one level of the hash encoding: eight corners of two features
HARMONIC = 4 * 3  # one function of the light in three colours, with its recurrence
ADAM, ADAM_BYTES, BAND = 12, 28, 6  # one coefficient; bytes it reads and writes; cells of the band that is fitted
SWEPT = 17 + 13  # sample of the plane sweep: projection, bilinear look-up, sums of a correlation
PLANES, PLANE = 100, 100  # planes of a small picture; pixel on one in one neighbour: warp, running sums, aggregation
PATCH = 25 * 30  # plane of a pixel in one neighbour: 25 projected samples
TRIALS = 1 + 2 * 7  # planes that are tried for a pixel
SHADOW_POINTS, SHADOW_RAYS = 12_000, 400  # nodes where shadows are solved; rays from each
BLOCK = 8  # lattice points evaluated for one that the surface crosses
COLLAPSE = 600  # face that decimation removes: quadrics and a heap
FLATTEN = 60 * 60  # face in 60 local and global iterations of ARAP
SUBDIVIDED = 500  # face of the subdivided template: limit surface, displacement, normals
SOLVED = 40 * 600  # vertex of the cage in 40 sweeps of the solver: 100 neighbours' numbers in three coordinates
CAGE_LEVEL = 4  # vertices of the cage over quads of the template, after one subdivision
NEAREST = 300  # place: the nearest one on a mesh, in a tree
TEXEL_VIEW, LAMP, LAMPS, BOUNCES = 60, 50, 384, 96  # texel in one photo; lamp of GGX; lamps; rays of bounces
GGX_WIDTHS, OBSERVED = 11, 0.3  # widths for which an observation is shaded; share of the photos that see a vertex
GGX_VERTICES = 3  # vertices of the mesh for one whose gloss is fitted
RENDERED, EDGE = 0.4, 4  # share of a picture that is subject; silhouette pixels over its side
PREVIEWS, EDGE_RAYS = 7, 64
FLIP, SSIM = 700, 250  # pixel


@dataclass(frozen=True, slots=True)
class Work:
    """What a stage has to do, in the units of Rates. vector: arithmetic on neighbouring pixels, lamps or
    coefficients; scalar: arithmetic around look-ups. moved: bytes read from and written to memory."""

    matrix: float = 0.0
    scalar: float = 0.0
    vector: float = 0.0
    moved: float = 0.0
    read: float = 0.0
    write: float = 0.0
    hashed: float = 0.0
    jpeg: float = 0.0
    png: float = 0.0
    exr: float = 0.0
    png_written: float = 0.0
    exr_written: float = 0.0
    rays: float = 0.0

    def seconds(self, rates: Rates) -> dict[str, float]:
        """Of each kind alone."""
        names = {f.name: "memory" if f.name == "moved" else f.name for f in fields(self)}
        return {name: getattr(self, name) / getattr(rates, rate) for name, rate in names.items()}

    def floor(self, rates: Rates) -> float:
        """Least seconds."""
        taken = self.seconds(rates)
        memory, disk = taken.pop("moved"), taken.pop("read") + taken.pop("write")
        return max(memory, disk, sum(taken.values()))

    def bound(self, rates: Rates) -> str:
        """The kind of work that takes most of it."""
        taken = self.seconds(rates)
        return max(taken, key=lambda name: taken[name])


# ------------------------------------------------------------------ the stages
def capture(c: Counts) -> Work:
    """Every photo is read, hashed, decoded, measured and copied."""
    return Work(
        vector=PIXEL_CHECKED * c.pixels,
        matrix=FACE_NETWORKS * c.photos,
        moved=6 * c.pixels,
        read=c.sources,
        write=c.written("capture"),
        hashed=c.sources,
        jpeg=c.jpeg,
        png=c.png,
    )


def poses(c: Counts) -> Work:
    """Features of small pictures, matches with neighbours. The mapper of solved cameras is not in the floor."""
    from stages.poses.epipolar_check import EDGE as CHECKED
    from stages.poses.epipolar_check import FEATURES, PARTNERS

    side = c.setting("poses.max_image_size") if c.solved else CHECKED
    features = c.setting("poses.max_features") if c.solved else FEATURES
    partners = c.setting("poses.neighbours") if c.solved else PARTNERS
    if not c.solved and c.choice("poses.check") is False:
        return Work(write=c.written("poses"))
    return Work(
        vector=PIXEL_FEATURES * c.photos * 0.75 * side**2,
        matrix=c.photos * partners / 2 * features**2 * 2 * DESCRIPTOR,
        read=c.sources,
        write=c.written("poses"),
        jpeg=c.jpeg,
        png=c.png,
    )


def masks(c: Counts) -> Work:
    """Every photo is decoded, cut out and compared with the hull; its mask is written at its size."""
    from stages.masks.segment import WORKING_SIZE

    small = min(c.pixels, c.photos * 0.75 * WORKING_SIZE**2)
    return Work(
        vector=PIXEL_CUT * small if c.person else PIXEL_KEYED * c.pixels,
        scalar=2.0 * VOXEL_VIEW * c.photos * c.setting("masks.hull_cells") ** 3,
        matrix=(PERSON_NETWORK * c.person + FACE_NETWORKS) * c.photos,
        moved=12 * c.pixels,
        read=c.sources,
        write=c.written("masks"),
        hashed=c.written("masks"),
        jpeg=c.jpeg,
        png=c.png,
        png_written=c.pixels / FLAT,
    )


def inverse_rendering(c: Counts) -> Work:
    """Stereo, steps, shadows and held-out pictures."""
    steps, held = c.setting("inverse_rendering.steps"), _held_pixels(c)
    rays = steps * c.setting("inverse_rendering.batch")
    matrix, scalar, light = shaded(c)
    band = BAND * c.area / max(_fit_cell(c), 1e-6) ** 2
    each = MARCH * SPLINE_VALUE + c.setting("inverse_rendering.samples") * SPLINE * BACKWARD
    return Work(
        matrix=(BACKWARD * 0.75 * rays + held) * matrix,
        scalar=rays * (each + BACKWARD * 0.75 * scalar) + held * (each / 2 + scalar) + swept(c) + depth_maps(c),
        vector=steps * ADAM * band + BACKWARD * 0.75 * rays * light + held * light,
        moved=steps * ADAM_BYTES * band + 24 * c.pixels,
        read=c.sources,
        write=c.written("inverse_rendering"),
        hashed=c.written("inverse_rendering"),
        jpeg=c.jpeg,
        png=c.png + c.pixels / 3,
        exr_written=held,
        rays=3.0 * SHADOW_POINTS * SHADOW_RAYS if c.choice("inverse_rendering.shadows") else 0.0,
    )


def shaded(c: Counts) -> tuple[float, float, float]:
    """Operations to shade one point: matrix products (the two networks), look-ups (encoding), and the light."""
    width, depth = c.setting("inverse_rendering.width"), c.setting("inverse_rendering.depth")
    levels, rank = c.setting("inverse_rendering.hash_levels"), max(c.rank, 1)
    inner = (depth - 1) * width * width
    networks = (2 * levels + 5 + rank) * width + inner + (7 + rank) * width + inner
    return 2 * networks, levels * CORNER, 2.0 * HARMONIC * (c.order + 1) ** 2


def swept(c: Counts) -> float:
    """Operations of the plane sweep."""
    from stages.inverse_rendering import stereo

    if c.choice("inverse_rendering.stereo") == "off":
        return 0.0
    pixels = stereo.SIDE * math.sqrt(c.subject)
    offsets = sum((s.outward + s.inward) * pixels / s.step for s in stereo.SWEEPS)
    return SWEPT * stereo.POINTS * stereo.VIEWS * (2 * stereo.HALF + 1) ** 2 * offsets


def depth_maps(c: Counts) -> float:
    """Operations of the depth maps."""
    from stages.inverse_rendering import dense_stereo as dense

    if c.choice("inverse_rendering.stereo") in ("off", "sweep"):
        return 0.0
    sweep = dense.COARSE**2 * PLANES * dense.NEIGHBOURS * PLANE
    refinement = dense.FINE**2 * TRIALS * dense.REFINED * PATCH
    return 0.5 * c.fitted * (sweep + refinement)


def surface(c: Counts) -> Work:
    """The field near its zero set, and triangles."""
    return Work(
        scalar=BLOCK * 0.5 * c.faces * SPLINE_VALUE + c.faces * SPLINE,
        write=c.written("surface"),
        hashed=c.written("surface"),
    )


def template(c: Counts) -> Work:
    """The cage follows the surface."""
    if not c.template:
        return Work(write=c.written("template"))
    from pipeline.template.load import load_template

    vertices = CAGE_LEVEL * len(load_template().quads)
    return Work(scalar=vertices * SOLVED + 40 * vertices * NEAREST, rays=float(vertices * c.fitted),
                write=c.written("template"), hashed=c.written("template"))  # fmt: skip


def uv(c: Counts) -> Work:
    """A mesh of the wanted size with charts, and a proxy."""
    own = SUBDIVIDED * c.render if c.template else COLLAPSE * c.faces + FLATTEN * c.render
    return Work(scalar=own + COLLAPSE * c.render + NEAREST * c.render, rays=float(c.render),
                write=c.written("uv"), hashed=c.written("uv"))  # fmt: skip


def bake(c: Counts) -> Work:
    """The field at every texel, detail of the photos, a standard material in the light that arrives, maps as files."""
    vertices = c.render / 2
    matrix, scalar, light = shaded(c)
    observed = vertices / GGX_VERTICES * c.fitted * OBSERVED
    return Work(
        matrix=c.texels * matrix,
        scalar=c.texels * (SPLINE + scalar + c.fitted * TEXEL_VIEW),
        vector=c.texels * light + observed * GGX_WIDTHS * LAMPS / 2 * LAMP,
        moved=c.texels * c.fitted * 16,
        read=c.sources,
        write=c.written("bake"),
        hashed=c.written("bake"),
        jpeg=c.jpeg,
        png=c.png,
        png_written=c.png_maps / 3,
        exr_written=c.exr_maps / 3,
        rays=vertices * (c.fitted + LAMPS / 2 + BOUNCES),
    )


def usd(c: Counts) -> Work:
    """Maps of the asset, its meshes, previews, films and the held-out views."""
    size = c.setting("usd.preview_size")
    shown = (PREVIEWS + 2 * c.setting("usd.film_frames")) * size**2 * RENDERED + _held_pixels(c)
    edges = EDGE * EDGE_RAYS * ((PREVIEWS + 2 * c.setting("usd.film_frames")) * size
                                + c.held * c.setting("inverse_rendering.image_side"))  # fmt: skip
    dense = min(c.setting("usd.high_faces"), c.faces)
    return Work(
        vector=shown * LAMPS / 2 * LAMP,
        scalar=dense * 3 * NEAREST + (COLLAPSE * c.faces if dense < c.faces else 0),
        write=c.written("usd"),
        hashed=c.written("usd"),
        png_written=c.png_maps / 3,
        exr_written=_held_pixels(c),
        rays=shown + edges,
    )


def report(c: Counts) -> Work:
    """Scores of the held-out views, model and asset, and one page."""
    pixels = 2 * c.held * c.setting("inverse_rendering.image_side") ** 2
    share = c.held / max(c.photos, 1)
    return Work(vector=pixels * (FLIP + SSIM), write=c.written("report"), hashed=c.written("report"),
                read=share * c.sources, jpeg=share * c.jpeg, png=share * c.png, exr=pixels)  # fmt: skip


def _held_pixels(c: Counts) -> float:
    """Pixels of the subject in the pictures of the held-out views."""
    return c.held * c.setting("inverse_rendering.image_side") ** 2 * c.subject


def _fit_cell(c: Counts) -> float:
    """Metres, of the fit's grid: the surface's lattice lies in the same box."""
    return c.cell * c.setting("surface.resolution") / c.setting("inverse_rendering.grid_cells") if c.cell else 0.0


STAGES: dict[str, Callable[[Counts], Work]] = {
    f.__name__: f for f in (capture, poses, masks, inverse_rendering, surface, template, uv, bake, usd, report)
}
