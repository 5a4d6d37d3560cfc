"""Reflection of the demo skin, integrated by sampling. Independent of the model that is fitted.

Symbols (all directions unit, in the local frame whose z axis is the normal)
    wo, wi  towards the eye and towards the light
    a       GGX width, roughness squared
    F0      reflectance at normal incidence, F = F0 + (1 - F0) (1 - wo.h)^5
    L       incident radiance, read from a cube-shaped table with bilinear interpolation

    diffuse  = albedo mean_i L(wi)                    wi ~ cos / pi
    specular = mean_i F(wo.h) G2 / G1 L(wi)           h ~ visible normals (Heitz 2018), wi = reflect(wo, h)

G2 is Smith's height-correlated masking. One bounce; the two lobes are added without coupling.
Samples are a low-discrepancy net of points, with a random shift for each pixel.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from pipeline.demo.compiled import compiled

F64 = npt.NDArray[np.float64]
F32 = npt.NDArray[np.float32]
Triple = tuple[float, float, float]

_GRAZING = 0.005  # least cosine between a shading normal and the eye


def cube_directions(cells: int) -> F64:
    """Unit directions (6, n, n, 3) of the table's nodes, n = cells + 1.

    Face 2 k is +axis k and face 2 k + 1 is -axis k; the other two axes follow in rising order. Nodes lie on
    the cube's edges too, so that no face needs its neighbour.
    """
    line = np.linspace(-1.0, 1.0, cells + 1)
    u, v = np.meshgrid(line, line, indexing="ij")
    out = np.empty((6, cells + 1, cells + 1, 3))
    for face in range(6):
        axis = face // 2
        first, second = (i for i in range(3) if i != axis)
        out[face, ..., axis] = 1.0 - 2.0 * (face % 2)
        out[face, ..., first] = u
        out[face, ..., second] = v
    return np.asarray(out / np.linalg.norm(out, axis=-1, keepdims=True))


def cube_table(radiance: Callable[[F64], F64], cells: int) -> F32:
    """Table (6, n, n, 3) of `radiance`, a function from unit directions (N, 3) to (N, 3)."""
    directions = cube_directions(cells)
    return radiance(directions.reshape(-1, 3)).reshape(directions.shape).astype(np.float32)


@compiled
def look_up(table: F32, x: float, y: float, z: float) -> Triple:
    """Bilinear radiance from direction (x, y, z), which need not be of unit length."""
    ax, ay, az = abs(x), abs(y), abs(z)
    if ax >= ay and ax >= az:
        face, u, v, major = (0 if x > 0.0 else 1), y, z, ax
    elif ay >= az:
        face, u, v, major = (2 if y > 0.0 else 3), x, z, ay
    else:
        face, u, v, major = (4 if z > 0.0 else 5), x, y, az
    cells = table.shape[1] - 1
    s = (u / major * 0.5 + 0.5) * cells
    t = (v / major * 0.5 + 0.5) * cells
    i, j = min(int(s), cells - 1), min(int(t), cells - 1)
    s, t = s - i, t - j
    a, b, c, d = (1 - s) * (1 - t), (1 - s) * t, s * (1 - t), s * t
    low, high = table[face, i], table[face, i + 1]
    return (
        a * low[j, 0] + b * low[j + 1, 0] + c * high[j, 0] + d * high[j + 1, 0],
        a * low[j, 1] + b * low[j + 1, 1] + c * high[j, 1] + d * high[j + 1, 1],
        a * low[j, 2] + b * low[j + 1, 2] + c * high[j, 2] + d * high[j + 1, 2],
    )


@compiled
def cosine_direction(u: float, cos_phi: float, sin_phi: float) -> Triple:
    """Direction distributed as cos / pi, from u in [0, 1) and a uniform angle phi."""
    r = math.sqrt(u)
    return r * cos_phi, r * sin_phi, math.sqrt(max(1.0 - u, 0.0))


@compiled
def visible_normal(wo: Triple, a: float, u: float, cos_phi: float, sin_phi: float) -> Triple:
    """GGX half vector distributed as seen from `wo` (wo.z > 0), from u in [0, 1) and a uniform angle phi."""
    x, y, z = a * wo[0], a * wo[1], wo[2]
    length = math.sqrt(x * x + y * y + z * z)
    x, y, z = x / length, y / length, z / length
    flat = x * x + y * y
    if flat > 1e-14:
        tx, ty = -y / math.sqrt(flat), x / math.sqrt(flat)
    else:
        tx, ty = 1.0, 0.0
    bx, by, bz = -z * ty, z * tx, x * ty - y * tx
    r = math.sqrt(u)
    p, q = r * cos_phi, r * sin_phi
    half = 0.5 * (1.0 + z)
    q = (1.0 - half) * math.sqrt(max(1.0 - p * p, 0.0)) + half * q
    w = math.sqrt(max(1.0 - p * p - q * q, 0.0))
    hx = a * (p * tx + q * bx + w * x)
    hy = a * (p * ty + q * by + w * y)
    hz = max(q * bz + w * z, 1e-9)
    length = math.sqrt(hx * hx + hy * hy + hz * hz)
    return hx / length, hy / length, hz / length


@compiled
def smith_lambda(cosine: float, a: float) -> float:
    """Smith's Lambda of GGX for a direction at `cosine` > 0 from the normal."""
    c2 = cosine * cosine
    return 0.5 * (math.sqrt(1.0 + a * a * max(1.0 - c2, 0.0) / c2) - 1.0)


@compiled
def specular_sample(
    wo: Triple, a: float, f0: float, u: float, cos_phi: float, sin_phi: float
) -> tuple[float, float, float, float]:
    """Reflected direction and its weight F G2 / G1; weight 0 where it falls below the horizon."""
    h = visible_normal(wo, a, u, cos_phi, sin_phi)
    cosine = max(wo[0] * h[0] + wo[1] * h[1] + wo[2] * h[2], 0.0)
    x, y, z = 2 * cosine * h[0] - wo[0], 2 * cosine * h[1] - wo[1], 2 * cosine * h[2] - wo[2]
    if z <= 1e-9:
        return x, y, z, 0.0
    out, into = smith_lambda(wo[2], a), smith_lambda(z, a)
    fresnel = f0 + (1.0 - f0) * (1.0 - cosine) ** 5
    return x, y, z, fresnel * (1.0 + out) / (1.0 + out + into)


@compiled
def local_frame(n: F64, v: F64) -> tuple[Triple, Triple, Triple, Triple]:
    """Tangent, bitangent and normal of a shading point, and the eye's direction in that frame.

    At a silhouette the normal may point away from the eye; it is then rotated to a grazing angle.
    """
    nx, ny, nz = n[0], n[1], n[2]
    cosine = nx * v[0] + ny * v[1] + nz * v[2]
    if cosine < _GRAZING:
        lift = _GRAZING - cosine
        nx, ny, nz = nx + lift * v[0], ny + lift * v[1], nz + lift * v[2]
        length = math.sqrt(nx * nx + ny * ny + nz * nz)
        nx, ny, nz = nx / length, ny / length, nz / length
    sign = 1.0 if nz >= 0.0 else -1.0
    k = -1.0 / (sign + nz)
    m = nx * ny * k
    t = (1.0 + sign * nx * nx * k, sign * m, -sign * nx)
    b = (m, sign + ny * ny * k, -ny)
    wo = (
        t[0] * v[0] + t[1] * v[1] + t[2] * v[2],
        b[0] * v[0] + b[1] * v[1] + b[2] * v[2],
        max(nx * v[0] + ny * v[1] + nz * v[2], _GRAZING),
    )
    return t, b, (nx, ny, nz), wo


@compiled
def to_world(t: Triple, b: Triple, n: Triple, x: float, y: float, z: float) -> Triple:
    """World direction of the local direction (x, y, z)."""
    return (
        x * t[0] + y * b[0] + z * n[0],
        x * t[1] + y * b[1] + z * n[1],
        x * t[2] + y * b[2] + z * n[2],
    )


@compiled
def sample_directions(normal: F64, to_eye: F64, f0: F64, a: F64, shift: F64, point: F64) -> tuple[F64, F64, F64]:
    """One sample for every shading point: diffuse and specular directions (N, 3), specular weight (N,).

    `normal`, `to_eye` (N, 3); `f0`, `a` (N,); `shift` (N, 2) rotates the net's `point` (2,).
    """
    count = normal.shape[0]
    diffuse, specular, weight = np.empty((count, 3)), np.empty((count, 3)), np.empty(count)
    for i in range(count):
        t, b, n, wo = local_frame(normal[i], to_eye[i])
        u, phi = (point[0] + shift[i, 0]) % 1.0, 2.0 * math.pi * (point[1] + shift[i, 1])
        cp, sp = math.cos(phi), math.sin(phi)
        x, y, z = cosine_direction(u, cp, sp)
        diffuse[i, 0], diffuse[i, 1], diffuse[i, 2] = to_world(t, b, n, x, y, z)
        x, y, z, weight[i] = specular_sample(wo, a[i], f0[i], u, cp, sp)
        specular[i, 0], specular[i, 1], specular[i, 2] = to_world(t, b, n, x, y, z)
    return diffuse, specular, weight


def shade(
    normal: F64, to_eye: F64, albedo: F64, f0: F64, a: F64, shift: F64, points: F64, table: F32
) -> tuple[F64, F64]:
    """Unshadowed radiance (N, 3) towards the eye, with the net `points` (S, 2) for each lobe, and the mirror
    reflection's part of it.

    `normal`, `to_eye`, `albedo` (N, 3); `f0`, `a` (N,); `shift` (N, 2); `table` as from `cube_table`.
    """
    diffuse, specular = sums(normal, to_eye, f0, a, shift, points, table)
    return np.asarray((albedo * diffuse + specular) / len(points)), np.asarray(specular / len(points))


@compiled
def sums(normal: F64, to_eye: F64, f0: F64, a: F64, shift: F64, points: F64, table: F32) -> tuple[F64, F64]:
    """Sums over the net of the light of diffuse samples, and of the weighted light of specular ones, (N, 3) each;
    arguments as of `shade`."""
    count, samples = normal.shape[0], points.shape[0]
    diffuse, specular = np.empty((count, 3)), np.empty((count, 3))
    cos, sin = np.cos(2.0 * math.pi * points[:, 1]), np.sin(2.0 * math.pi * points[:, 1])
    for i in range(count):
        t, b, n, wo = local_frame(normal[i], to_eye[i])
        # Shifting the net by an angle needs one sine per point, not one per sample.
        c0, s0 = math.cos(2.0 * math.pi * shift[i, 1]), math.sin(2.0 * math.pi * shift[i, 1])
        dr, dg, db, sr, sg, sb = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for s in range(samples):
            u = points[s, 0] + shift[i, 0]
            u -= 1.0 if u >= 1.0 else 0.0
            cp, sp = cos[s] * c0 - sin[s] * s0, sin[s] * c0 + cos[s] * s0
            x, y, z = cosine_direction(u, cp, sp)
            wx, wy, wz = to_world(t, b, n, x, y, z)
            red, green, blue = look_up(table, wx, wy, wz)
            dr, dg, db = dr + red, dg + green, db + blue
            x, y, z, weight = specular_sample(wo, a[i], f0[i], u, cp, sp)
            if weight > 0.0:
                wx, wy, wz = to_world(t, b, n, x, y, z)
                red, green, blue = look_up(table, wx, wy, wz)
                sr, sg, sb = sr + weight * red, sg + weight * green, sb + weight * blue
        diffuse[i, 0], diffuse[i, 1], diffuse[i, 2] = dr, dg, db
        specular[i, 0], specular[i, 1], specular[i, 2] = sr, sg, sb
    return diffuse, specular


@compiled
def look_up_many(table: F32, directions: F64) -> F64:
    """Radiance (N, 3) from `directions` (N, 3)."""
    out = np.empty((directions.shape[0], 3))
    for i in range(directions.shape[0]):
        out[i, 0], out[i, 1], out[i, 2] = look_up(table, directions[i, 0], directions[i, 1], directions[i, 2])
    return out
