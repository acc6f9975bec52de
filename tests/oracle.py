"""What the package computes, once more: plain NumPy loops in float64, from the definitions.

Nothing here is imported from the package and nothing is fast. Clouds hold valid points only,
unless a count or a mask says otherwise.
"""

import math

import numpy as np


def rotation_from_euler(angles):
    """Rz(c) Ry(b) Rx(a) for angles (a, b, c) in radians: three elementary rotations."""
    a, b, c = (float(x) for x in angles)
    about_x = [[1, 0, 0], [0, math.cos(a), -math.sin(a)], [0, math.sin(a), math.cos(a)]]
    about_y = [[math.cos(b), 0, math.sin(b)], [0, 1, 0], [-math.sin(b), 0, math.cos(b)]]
    about_z = [[math.cos(c), -math.sin(c), 0], [math.sin(c), math.cos(c), 0], [0, 0, 1]]
    return np.array(about_z) @ np.array(about_y) @ np.array(about_x)


def homogeneous(rotation, translation):
    """The 4 x 4 matrix of a motion; products and inverses of these are the algebra of motions."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = translation
    return matrix


def apply(rotation, translation, points):
    """Rotation @ x + translation, point by point."""
    matrix = homogeneous(rotation, translation)
    return np.array([(matrix @ np.append(point, 1.0))[:3] for point in np.float64(points)])


def procrustes(source, target, weights):
    """The motion minimising sum_i w_i |R s_i + t - q_i|^2, by quaternions (Horn 1987), not SVD."""
    source, target = np.float64(source), np.float64(target)
    weights = np.float64(weights) / np.sum(np.float64(weights))
    s_mean = sum(w * s for w, s in zip(weights, source, strict=True))
    q_mean = sum(w * q for w, q in zip(weights, target, strict=True))
    m = np.zeros((3, 3))
    for w, s, q in zip(weights, source, target, strict=True):
        m += w * np.outer(s - s_mean, q - q_mean)
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = m
    form = np.array(
        [
            [xx + yy + zz, yz - zy, zx - xz, xy - yx],
            [yz - zy, xx - yy - zz, xy + yx, zx + xz],
            [zx - xz, xy + yx, yy - xx - zz, yz + zy],
            [xy - yx, zx + xz, yz + zy, zz - xx - yy],
        ]
    )
    w, x, y, z = np.linalg.eigh(form)[1][:, -1]
    rotation = np.array(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
    )
    return rotation, q_mean - rotation @ s_mean


def squared_distance(a, b):
    """|a - b|^2 of two points."""
    return sum((float(x) - float(y)) ** 2 for x, y in zip(a, b, strict=True))


def farthest_samples(points, size):
    """Indices of ``size`` farthest-point samples, starting at row 0; the lower row on ties."""
    chosen = [0][:size]
    while len(chosen) < size:
        best, best_distance = -1, -1.0
        for i in range(len(points)):
            if i in chosen:
                continue
            distance = min(squared_distance(points[i], points[j]) for j in chosen)
            if distance > best_distance:
                best, best_distance = i, distance
        chosen.append(best)
    return chosen


def farthest_order(points, count):
    """Half of the valid rows by farthest-point sampling, the other valid rows, the padding."""
    chosen = farthest_samples(points[:count], count // 2)
    others = [i for i in range(count) if i not in chosen]
    return np.array(chosen + others + list(range(count, len(points))))


def half_space_crop(points, direction, size):
    """Rows of the ``size`` points farthest along ``direction``, ascending."""
    along = [sum(x * d for x, d in zip(point, direction, strict=True)) for point in points]
    return np.array(sorted(sorted(range(len(points)), key=lambda i: -along[i])[:size]))


def ball_crop(points, centre, size):
    """Rows of the ``size`` points nearest to ``centre``, ascending."""
    away = [sum((x - c) ** 2 for x, c in zip(point, centre, strict=True)) for point in points]
    return np.array(sorted(sorted(range(len(points)), key=lambda i: away[i])[:size]))


def knn(query, points, k, count):
    """The k nearest of the first ``count`` points, nearest first, padded with the nearest."""
    rows = []
    for q in query:
        order = sorted(range(count), key=lambda j: squared_distance(q, points[j]))[:k]
        rows.append(order + [order[0]] * (k - len(order)))
    return np.array(rows)


def interpolate(features, dense, sparse, count):
    """Mean of the three nearest sparse features, weighted by 1 / (distance + 1e-8)."""
    out = np.zeros((len(dense), features.shape[1]))
    for i, index in enumerate(knn(dense, sparse, 3, count)):
        weights = [1.0 / (math.sqrt(squared_distance(dense[i], sparse[j])) + 1e-8) for j in index]
        for w, j in zip(weights, index, strict=True):
            out[i] += w / sum(weights) * np.float64(features[j])
    return out


def local_invariants(points, radii, deviation=0.6):
    """Eight numbers about each point for each radius, from the eigenvectors of each covariance."""
    rows = []
    for point in np.float64(points):
        row = []
        for r in radii:
            weights = [
                math.exp(-squared_distance(point, q) / (2 * (deviation * r) ** 2)) for q in points
            ]
            mass = sum(weights)
            mean = sum(w * np.float64(q) for w, q in zip(weights, points, strict=True)) / mass
            m = np.zeros((3, 3))
            for w, q in zip(weights, points, strict=True):
                m += w * np.outer(q - mean, q - mean) / mass / r**2
            o = (mean - point) / r
            a, b, c = np.maximum(np.linalg.eigvalsh(m), 0.0)
            turn = np.linalg.det(np.array([o, m @ o, m @ m @ o]))
            row += [a + b + c, math.sqrt(a * b + b * c + c * a), np.cbrt(a * b * c)]
            row += [np.linalg.norm(o), math.log(mass / len(points))]
            row += [math.sqrt(max(o @ m @ o, 0.0)), math.sqrt(np.linalg.norm(m @ o)), np.cbrt(turn)]
        rows.append(row)
    return np.array(rows)


def attention(query, key, value, valid, heads):
    """softmax(q k / sqrt(width)) v per head over the valid keys; zeros where none is valid."""
    n, d = query.shape
    width = d // heads
    out = np.zeros((n, d))
    for head in range(heads):
        part = slice(head * width, (head + 1) * width)
        for i in range(n):
            logits = {
                j: float(np.float64(query[i, part]) @ np.float64(key[j, part])) / math.sqrt(width)
                for j in range(len(key))
                if valid[j]
            }
            total = sum(math.exp(x) for x in logits.values())
            for j, x in logits.items():
                out[i, part] += math.exp(x) / total * np.float64(value[j, part])
    return out


def position_code(points, width):
    """Sin and cos, alternating, of 2 pi x / 10000^(2 i / channels), axis after axis, then zeros."""
    channels = width // 3 // 2 * 2
    out = np.zeros((len(points), width))
    for row, point in enumerate(points):
        for axis in range(3):
            for i in range(channels // 2):
                angle = 2 * math.pi * float(point[axis]) / 10000 ** (2 * i / channels)
                out[row, axis * channels + 2 * i] = math.sin(angle)
                out[row, axis * channels + 2 * i + 1] = math.cos(angle)
    return out


def sinkhorn(affinity, row_valid, column_valid, iterations):
    """Rows, then columns of exp(affinity) divided by their sums, slack included; masked are 0."""
    rows, columns = np.flatnonzero(row_valid), np.flatnonzero(column_valid)
    mass = np.ones((len(rows) + 1, len(columns) + 1))  # the last row and column are the slack
    mass[:-1, :-1] = np.exp(np.float64(affinity)[np.ix_(rows, columns)])
    for _ in range(iterations):
        for i in range(len(rows)):
            mass[i] /= mass[i].sum()
        for j in range(len(columns)):
            mass[:, j] /= mass[:, j].sum()
    out = np.zeros(affinity.shape)
    out[np.ix_(rows, columns)] = mass[:-1, :-1]
    return out


def group_norm(x, groups, scale, bias, eps=1e-5):
    """Mean 0 and variance 1 over all axes but the last and over each group of channels."""
    out = np.array(x, np.float64)
    for channels in np.array_split(np.arange(x.shape[-1]), groups):
        part = out[..., channels]
        out[..., channels] = (part - part.mean()) / math.sqrt(part.var() + eps)
    return out * scale + bias


def edge_conv(features, k, layers, groups, slope=0.2):
    """Maximum over the k neighbours in feature space of two layers on [f_j - f_i, f_i].

    ``layers`` holds two tuples (kernel (in, out), bias, norm scale, norm bias); each layer is a
    1 x 1 convolution, group norm over points, neighbours and the channels of a group, LeakyReLU.
    """
    features = np.float64(features)
    neighbours = knn(features, features, k, len(features))
    x = np.array(
        [
            [np.concatenate([features[j] - features[i], features[i]]) for j in row]
            for i, row in enumerate(neighbours)
        ]
    )
    for kernel, bias, scale, norm_bias in layers:
        x = group_norm(x @ np.float64(kernel) + bias, groups, scale, norm_bias)
        x = np.where(x > 0, x, slope * x)
    return x.max(axis=1)


def transition_down(points, features, kept, k, kernel, bias):
    """Maximum of ReLU(dense(features)) over the k neighbours of each kept row among all points."""
    mapped = np.maximum(np.float64(features) @ np.float64(kernel) + bias, 0.0)
    neighbours = knn([points[i] for i in kept], points, k, len(points))
    return np.array([np.max([mapped[j] for j in row], axis=0) for row in neighbours])
