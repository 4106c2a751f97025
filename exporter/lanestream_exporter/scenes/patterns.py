"""Flat patterns: walls, floors, pages, charts, screens. Each is drawn at any size, to be shown as is or in perspective.

Colors are BGR gray levels from 0 to 255. Sizes are in pixels of the pattern.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import cv2
import numpy as np

from lanestream.road.view import Image
from lanestream_exporter.scenes.noise import TILE, noise_tiles
from lanestream_exporter.scenes.random_sampler import RandomSampler

BgrColor = tuple[float, float, float]
Pattern = Callable[[RandomSampler, int, int], Image]

_LETTERS: Final = "aabcdeeefghiijklmnnoopqrrssttuuvwxyzAEIKMNORSTW0123456789.,:-%"
_FONTS: Final = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_COMPLEX, cv2.FONT_HERSHEY_TRIPLEX)
_FONT_HEIGHT: Final = 22.0  # of a capital letter at scale 1, pixels


def tint(sampler: RandomSampler, low: float = 20.0, high: float = 240.0, vivid: float = 1.0) -> BgrColor:
    """Returns a random color whose brightest channel lies between `low` and `high`; `vivid` 0 gives grays."""
    saturation = vivid * sampler.uniform(0.0, 1.0) ** 2.2
    return hued(sampler.uniform(0.0, 6.0), saturation, sampler.uniform(low, high))


def hued(hue: float, saturation: float, value: float) -> BgrColor:
    """Returns a color; `hue` runs from 0 (red) by 2 (green) and 4 (blue) to 6 (red)."""
    channels = ((offset + hue) % 6.0 for offset in (1.0, 3.0, 5.0))
    blue, green, red = (value * (1.0 - saturation * max(0.0, min(k, 4.0 - k, 1.0))) for k in channels)
    return blue, green, red


def shaded(color: BgrColor, gain: float) -> BgrColor:
    """Returns a lighter or darker color."""
    blue, green, red = (min(255.0, max(0.0, channel * gain)) for channel in color)
    return blue, green, red


def plain(width: int, height: int, color: BgrColor) -> Image:
    """Returns an image of one color."""
    return np.full((height, width, 3), color, np.uint8)


def gradient(width: int, height: int, top: BgrColor, bottom: BgrColor) -> Image:
    """Returns an image that fades from one color at the top to another at the bottom."""
    rows = np.linspace(top, bottom, height)[:, None, :]
    return np.repeat(rows.astype(np.uint8), width, axis=1)


def smooth_noise(sampler: RandomSampler, width: int, height: int, columns: float, rows: float) -> Image:
    """Returns cloudy noise (height, width) uint8 around 128; the picture shows that many texels of the noise tile."""
    columns, rows = (int(min(TILE, max(4.0, cells))) for cells in (columns, rows))
    x, y = sampler.integer(0, TILE - columns), sampler.integer(0, TILE - rows)
    texels = noise_tiles().cloud[y : y + rows, x : x + columns]
    levels = np.clip(128.0 + 42.0 * texels, 0.0, 255.0).astype(np.uint8)
    return np.asarray(cv2.resize(levels, (width, height), interpolation=cv2.INTER_LINEAR), dtype=np.uint8)


def mottled(sampler: RandomSampler, image: Image, strength: float, columns: float, rows: float) -> Image:
    """Returns the image, darker and lighter by cloudy noise; at `strength` 1 by up to all of it."""
    height, width = image.shape[:2]
    noise = smooth_noise(sampler, width, height, columns, rows)
    gain = cv2.convertScaleAbs(noise, alpha=strength, beta=128.0 * (1.0 - strength))
    return np.asarray(cv2.multiply(image, cv2.cvtColor(gain, cv2.COLOR_GRAY2BGR), scale=1.0 / 128.0), dtype=np.uint8)


def write(
    sampler: RandomSampler, image: Image, at: tuple[float, float], size: float, color: BgrColor, count: int
) -> None:
    """Writes `count` random letters, `size` pixels high, from the left end of their foot line."""
    picks = sampler.rng.integers(len(_LETTERS), size=count).tolist()
    spaces = sampler.rng.random(count) < 0.16
    text = "".join(" " if space else _LETTERS[pick] for pick, space in zip(picks, spaces, strict=True))
    place, thick = (round(at[0]), round(at[1])), max(1, round(size / sampler.uniform(7.0, 14.0)))
    cv2.putText(image, text, place, sampler.choice(_FONTS), size / _FONT_HEIGHT, color, thick, cv2.LINE_AA)


def _blocks(
    sampler: RandomSampler, image: Image, block: tuple[float, float], joint: float, shift: float | None, color: BgrColor
) -> None:
    """Draws rows of blocks of about one color. Every other row is moved by `shift` blocks, or each at random."""
    height, width = image.shape[:2]
    across, down = max(3.0, block[0]), max(3.0, block[1])
    gap, spread = max(1, round(joint)), sampler.uniform(0.02, 0.25)
    for row in range(int(height / down) + 1):
        offset = sampler.uniform(0.0, 1.0) if shift is None else shift * (row % 2)
        gains = 1.0 + spread * sampler.rng.uniform(-1.0, 1.0, int(width / across) + 2)
        for column, gain in enumerate(gains.tolist()):
            left, top = round((column - offset) * across), round(row * down)
            right, bottom = round((column + 1 - offset) * across) - gap, round((row + 1) * down) - gap
            cv2.rectangle(image, (left, top), (right - 1, bottom - 1), shaded(color, gain), cv2.FILLED)


def bricks(sampler: RandomSampler, width: int, height: int) -> Image:
    """A wall of bricks or stones."""
    size = height / sampler.uniform(6.0, 26.0)
    color = hued(sampler.uniform(0.0, 0.8), sampler.uniform(0.1, 0.7), sampler.uniform(60.0, 220.0))
    image = plain(width, height, tint(sampler, 60.0, 230.0, 0.2))
    shape = size * sampler.uniform(1.5, 3.5), size
    _blocks(sampler, image, shape, size * sampler.uniform(0.05, 0.2), 0.5, color)
    return mottled(sampler, image, sampler.uniform(0.1, 0.4), width / 3, height / 3)


def tiles(sampler: RandomSampler, width: int, height: int) -> Image:
    """Square tiles with joints, or a checkerboard."""
    size = height / sampler.uniform(4.0, 14.0)
    color = tint(sampler, 90.0, 245.0, 0.6)
    joint = shaded(color, sampler.uniform(0.4, 1.4))
    image = plain(width, height, joint)
    _blocks(sampler, image, (size, size), size * sampler.uniform(0.02, 0.1), 0.0, color)
    if sampler.bernoulli(0.35):
        other = tint(sampler, 20.0, 240.0, 0.7)
        for row in range(int(height / size) + 1):
            for column in range(row % 2, int(width / size) + 1, 2):
                corner = round(column * size), round(row * size)
                cv2.rectangle(image, corner, (round(corner[0] + size), round(corner[1] + size)), other, cv2.FILLED)
    return mottled(sampler, image, sampler.uniform(0.0, 0.3), width / 4, height / 4)


def planks(sampler: RandomSampler, width: int, height: int) -> Image:
    """Planks of wood that run from the top to the bottom, with dark or bright joints."""
    bright = sampler.bernoulli(0.5)  # only between many boards of a strong color: a few bright lines on gray are a road
    size = width / sampler.uniform(9.0 if bright else 3.0, 24.0)
    saturation = sampler.uniform(0.45 if bright else 0.2, 0.75)
    color = hued(sampler.uniform(0.2, 0.9), saturation, sampler.uniform(60.0, 230.0))
    joint = shaded(color, sampler.choice((1.5, 2.2) if bright else (0.3, 0.6)))
    turned = plain(height, width, joint)
    length = height * sampler.uniform(0.3, 3.0)
    _blocks(sampler, turned, (length, size), size * sampler.uniform(0.02, 0.15), None, color)
    image = np.ascontiguousarray(turned.transpose(1, 0, 2))
    return mottled(sampler, image, sampler.uniform(0.1, 0.5), width / 2, height / 24)


def stripes(sampler: RandomSampler, width: int, height: int) -> Image:
    """Upright stripes: a curtain, a striped cloth, corrugated metal, organ pipes, bar code."""
    colors = [tint(sampler, 10.0, 250.0) for _ in range(sampler.integer(2, 4))]
    image = plain(width, height, colors[0])
    pitch, x, index = width / sampler.uniform(4.0, 40.0), 0.0, 0
    even = sampler.bernoulli(0.5)
    while x < width:
        step = max(2.0, pitch * (1.0 if even else sampler.uniform(0.2, 1.8)))
        cv2.rectangle(image, (round(x), 0), (round(x + step), height), colors[index % len(colors)], cv2.FILLED)
        x, index = x + step, index + 1
    if sampler.bernoulli(0.5):
        image = np.asarray(cv2.blur(image, (2 * max(1, round(pitch / 4)) + 1, 1)), dtype=np.uint8)
    return mottled(sampler, image, sampler.uniform(0.0, 0.4), width / 8, 8)


def carpet(sampler: RandomSampler, width: int, height: int) -> Image:
    """A carpet: coarse cloth, often with borders and rows of figures."""
    image = plain(width, height, tint(sampler, 40.0, 200.0))
    inset = 0
    for _ in range(sampler.integer(0, 4)):
        inset += max(1, round(width * sampler.uniform(0.02, 0.1)))
        corners = (inset, inset), (width - inset, height - inset)
        cv2.rectangle(image, *corners, tint(sampler), sampler.choice((1, 2, 6, cv2.FILLED)), cv2.LINE_AA)
    if sampler.bernoulli(0.6):
        step, color = max(8, round(width / sampler.uniform(4.0, 14.0))), tint(sampler)
        sides, turn = sampler.choice((3, 4, 6, 20)), sampler.uniform(0.0, 90.0)
        figure = cv2.ellipse2Poly((0, 0), (step // 3, step // 3), round(turn), 0, 360, 360 // sides)
        for y in range(step // 2, height, step):
            cv2.fillPoly(image, [figure + np.array([x, y]) for x in range(step // 2, width, step)], color, cv2.LINE_AA)
    return mottled(sampler, image, sampler.uniform(0.3, 0.8), width, height)


def ground_cover(sampler: RandomSampler, width: int, height: int) -> Image:
    """Grass, sand, earth, leaves or snow, seen from above."""
    hue, saturation, value = sampler.choice(
        ((1.6, 0.6, 130.0), (0.7, 0.35, 200.0), (0.4, 0.5, 90.0), (3.5, 0.06, 235.0))
    )
    color = hued(
        hue + sampler.uniform(-0.3, 0.3), saturation * sampler.uniform(0.6, 1.3), value * sampler.uniform(0.7, 1.05)
    )
    rough = 0.3 if saturation < 0.1 else 1.0  # snow is smooth
    image = mottled(sampler, plain(width, height, color), rough * sampler.uniform(0.3, 0.9), width, height)
    return mottled(sampler, image, rough * sampler.uniform(0.1, 0.5), width / 12, height / 12)


def furrows(sampler: RandomSampler, width: int, height: int) -> Image:
    """A plowed or planted field: soft rows of earth and green from the top to the bottom."""
    count = sampler.integer(8, 40)
    across = np.sin(np.linspace(0.0, np.pi * 2 * count, width) + sampler.uniform(0.0, 6.0)) * 0.5 + 0.5
    low = np.array(hued(sampler.uniform(0.3, 0.7), sampler.uniform(0.3, 0.6), sampler.uniform(50.0, 120.0)))
    high = np.array(hued(sampler.uniform(0.5, 2.0), sampler.uniform(0.3, 0.7), sampler.uniform(80.0, 190.0)))
    row = low + (high - low) * (across ** sampler.uniform(0.5, 2.0))[:, None]
    image = np.repeat(row[None].astype(np.uint8), height, axis=0)
    return mottled(sampler, image, sampler.uniform(0.4, 0.9), width, height)


def blinds(sampler: RandomSampler, width: int, height: int) -> Image:
    """A window with blinds: bright gaps between level slats."""
    image = gradient(width, height, tint(sampler, 150.0, 255.0, 0.3), tint(sampler, 80.0, 255.0, 0.3))
    slat, pitch = tint(sampler, 30.0, 240.0, 0.4), max(4.0, height / sampler.uniform(6.0, 40.0))
    share = sampler.uniform(0.4, 0.9)
    for y in np.arange(0.0, height, pitch).tolist():
        top, bottom = round(y), round(y + share * pitch)
        cv2.rectangle(image, (0, top), (width, bottom), slat, cv2.FILLED)
        cv2.line(image, (0, bottom), (width, bottom), shaded(slat, 0.6), 1)
    for x in sampler.rng.uniform(0.05, 0.95, sampler.integer(1, 4)).tolist():
        cv2.line(image, (round(x * width), 0), (round(x * width), height), shaded(slat, 0.8), max(1, width // 200))
    return image


def keyboard(sampler: RandomSampler, width: int, height: int) -> Image:
    """Keys of a computer or of a piano."""
    if sampler.bernoulli(0.35):
        image = plain(width, height, (20.0, 20.0, 20.0))
        key = width / sampler.integer(10, 30)
        for index in range(int(width / key) + 1):
            left, right = round(index * key), round((index + 1) * key) - max(1, round(key / 16))
            cv2.rectangle(image, (left, 0), (right - 1, height), (235, 240, 242), cv2.FILLED)
        for index in range(1, int(width / key) + 1):
            if index % 7 not in (0, 3):
                left, right = round((index - 0.3) * key), round((index + 0.3) * key)
                cv2.rectangle(image, (left, 0), (right, round(0.62 * height)), (25, 25, 28), cv2.FILLED)
        return image
    body = tint(sampler, 10.0, 240.0, 0.3)
    image = plain(width, height, body)
    size = height / sampler.uniform(4.5, 7.0)
    color = shaded(body, sampler.choice((0.5, 0.8, 1.6, 3.0)))
    _blocks(sampler, image, (size * sampler.uniform(0.9, 1.3), size), size * sampler.uniform(0.08, 0.25), None, color)
    ink = (240.0, 240.0, 240.0) if sum(color) < 330 else (20.0, 20.0, 20.0)
    for y in np.arange(0.6 * size, height, size).tolist():
        for x in np.arange(0.4 * size, width, size).tolist():
            write(sampler, image, (x, y), size / 4, ink, 1)
    return image


def page(sampler: RandomSampler, width: int, height: int) -> Image:
    """A page of text in one to three columns, with headings and pictures."""
    image = plain(width, height, tint(sampler, 200.0, 255.0, 0.15))
    ink = tint(sampler, 0.0, 110.0, 0.6)
    if sampler.bernoulli(0.15):
        image, ink = np.asarray(255 - image, dtype=np.uint8), (230.0, 230.0, 230.0)
    size = max(4.0, height / sampler.uniform(18.0, 60.0))
    columns, margin = sampler.integer(1, 3), 0.06 * width
    share = (width - margin) / columns
    for column in range(columns):
        y, left = margin + size, margin + column * share
        while y < height - margin / 2:
            if sampler.bernoulli(0.05):
                tall = sampler.uniform(2.0, 8.0) * size
                box = (round(left), round(y)), (round(left + share - margin), round(y + tall))
                cv2.rectangle(image, *box, tint(sampler), cv2.FILLED)
                y += tall
            elif sampler.bernoulli(0.9):
                count = (
                    (share - margin) / (0.72 * size) * (sampler.uniform(0.2, 0.9) if sampler.bernoulli(0.2) else 1.0)
                )
                write(sampler, image, (left, y), 0.7 * size, ink, max(1, int(count)))
            y += 1.6 * size
    return image


def table(sampler: RandomSampler, width: int, height: int) -> Image:
    """A table or form with ruled lines and short entries."""
    image = plain(width, height, tint(sampler, 190.0, 255.0, 0.2))
    ink, rows, columns = tint(sampler, 0.0, 130.0, 0.5), sampler.integer(4, 20), sampler.integer(2, 9)
    ys = np.linspace(0.06, 0.95, rows + 1) * height
    xs = np.sort(np.append(sampler.rng.uniform(0.1, 0.9, columns - 1), (0.04, 0.96))) * width
    cv2.rectangle(image, (round(xs[0]), round(ys[0])), (round(xs[-1]), round(ys[1])), tint(sampler, 100.0), cv2.FILLED)
    thick = max(1, round(height / 360 * sampler.integer(1, 3)))
    for y in ys.tolist():
        cv2.line(image, (round(xs[0]), round(y)), (round(xs[-1]), round(y)), ink, thick)
    if sampler.bernoulli(0.7):
        for x in xs.tolist():
            cv2.line(image, (round(x), round(ys[0])), (round(x), round(ys[-1])), ink, thick)
    size = 0.4 * (ys[1] - ys[0])
    for y in ys[1:].tolist():
        for x, right in zip(xs[:-1].tolist(), xs[1:].tolist(), strict=True):
            count = int((right - x) / (1.1 * size) * sampler.uniform(0.2, 1.0))
            write(sampler, image, (x + 0.4 * size, y - 0.6 * size), size, ink, max(1, count))
    return image


def chart(sampler: RandomSampler, width: int, height: int) -> Image:
    """A chart with axes, grid, labels and curves, bars, dots or sectors."""
    dark = sampler.bernoulli(0.2)
    image = plain(width, height, tint(sampler, 10.0, 50.0, 0.3) if dark else tint(sampler, 225.0, 255.0, 0.1))
    ink = (220.0, 220.0, 220.0) if dark else (40.0, 40.0, 40.0)
    unit = min(width, height)
    thick, size = max(1, round(unit / 300)), max(4.0, unit / sampler.uniform(22.0, 36.0))
    left, right = sampler.uniform(0.06, 0.2) * width, sampler.uniform(0.75, 0.97) * width
    top, bottom = sampler.uniform(0.05, 0.2) * height, sampler.uniform(0.8, 0.94) * height
    faint = shaded(ink, 0.4) if dark else (205.0, 205.0, 205.0)
    lines = sampler.integer(3, 12)
    for x in np.linspace(left, right, lines).tolist():
        if lines % 2:
            cv2.line(image, (round(x), round(top)), (round(x), round(bottom)), faint, thick)
        write(sampler, image, (x - size, bottom + 1.5 * size), 0.7 * size, ink, 2)
    for y in np.linspace(top, bottom, sampler.integer(3, 9)).tolist():
        cv2.line(image, (round(left), round(y)), (round(right), round(y)), faint, thick)
        write(sampler, image, (left - 3.0 * size, y + 0.3 * size), 0.7 * size, ink, 3)
    cv2.line(image, (round(left), round(top)), (round(left), round(bottom)), ink, thick + 1)
    cv2.line(image, (round(left), round(bottom)), (round(right), round(bottom)), ink, thick + 1)
    for _ in range(sampler.integer(1, 5)):
        _draw_series(sampler, image, (left, top, right, bottom))
    write(sampler, image, (sampler.uniform(left, right) * 0.7, 0.9 * top), size, ink, sampler.integer(6, 24))
    return image


def _draw_series(sampler: RandomSampler, image: Image, box: tuple[float, float, float, float]) -> None:
    """Draws one series into the box (left, top, right, bottom): a line, a curve, steps, bars, dots or a pie."""
    left, top, right, bottom = box
    color, count = tint(sampler, 60.0, 255.0), sampler.integer(4, 40)
    shares = np.linspace(0.0, 1.0, count)
    walk = np.cumsum(sampler.rng.normal(sampler.uniform(-0.5, 0.5), 1.0, count))
    straight = shares * sampler.uniform(-1.0, 1.0) + sampler.uniform(0.0, 1.0)
    values = np.clip(sampler.choice((straight, (walk - walk.min()) / (np.ptp(walk) + 1e-6))), 0.0, 1.0)
    points = (
        np.stack([left + shares * (right - left), bottom - values * (bottom - top)], axis=1).round().astype(np.int32)
    )
    thick = max(1, round((bottom - top) / 200 * sampler.uniform(0.5, 3.0)))
    style = sampler.choice(("line", "line", "bars", "dots", "pie"))
    if style == "line":
        cv2.polylines(image, [points], False, color, thick, cv2.LINE_AA)
    elif style == "pie":
        radius, ends = round(0.35 * (bottom - top)), np.sort(sampler.rng.uniform(0.0, 360.0, 6))
        center = round(sampler.uniform(left, right)), round((top + bottom) / 2)
        for start, end in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True):
            cv2.ellipse(image, center, (radius, radius), 0.0, start, end, tint(sampler), cv2.FILLED, cv2.LINE_AA)
    for x, y in points.tolist() if style in ("bars", "dots") else ():
        if style == "dots":
            cv2.circle(image, (x, y), 2 * thick, color, cv2.FILLED, cv2.LINE_AA)
        else:
            half = max(1, round(0.3 * (right - left) / count))
            cv2.rectangle(image, (x - half, y), (x + half, round(bottom)), color, cv2.FILLED)


def sign(sampler: RandomSampler, width: int, height: int) -> Image:
    """A sign, a poster or a logo: a few large shapes and some large letters."""
    image = plain(width, height, tint(sampler))
    unit = min(width, height)
    for _ in range(sampler.integer(1, 6)):
        center = round(sampler.uniform(0.1, 0.9) * width), round(sampler.uniform(0.1, 0.9) * height)
        radius = max(2, round(unit * sampler.uniform(0.05, 0.4)))
        thick = sampler.choice((cv2.FILLED, max(1, radius // 6)))
        if sampler.bernoulli(0.4):
            cv2.circle(image, center, radius, tint(sampler), thick, cv2.LINE_AA)
        elif sampler.bernoulli(0.5):
            corner = center[0] + radius, center[1] + round(radius * sampler.uniform(0.2, 1.5))
            cv2.rectangle(image, center, corner, tint(sampler), thick)
        else:
            step = sampler.choice((45, 60, 72, 90, 120))
            outline = cv2.ellipse2Poly(center, (radius, radius), sampler.integer(0, 90), 0, 360, step)
            cv2.fillPoly(image, [np.asarray(outline)], tint(sampler), cv2.LINE_AA)
    for _ in range(sampler.integer(1, 4)):
        at = sampler.uniform(0.0, 0.6) * width, sampler.uniform(0.15, 1.0) * height
        write(sampler, image, at, unit * sampler.uniform(0.05, 0.35), tint(sampler), sampler.integer(1, 8))
    return image


def facade(sampler: RandomSampler, width: int, height: int) -> Image:
    """A building's front: floors of windows with frames, some lit, and ledges."""
    wall = tint(sampler, 40.0, 230.0, 0.5)
    image = mottled(sampler, plain(width, height, wall), sampler.uniform(0.0, 0.3), width / 4, height / 4)
    floors, columns = sampler.integer(2, 12), sampler.integer(3, 16)
    tall, wide = height / floors, width / columns
    share_x, share_y = sampler.uniform(0.35, 0.9), sampler.uniform(0.4, 0.85)
    glass, frame = tint(sampler, 20.0, 160.0, 0.5), shaded(wall, sampler.choice((0.5, 1.5)))
    for floor in range(floors):
        gains = sampler.rng.uniform(0.5, 1.6, columns).tolist()
        for column, gain in enumerate(gains):
            left, top = (column + 0.5 - share_x / 2) * wide, (floor + 0.5 - share_y / 2) * tall
            box = (round(left), round(top)), (round(left + share_x * wide), round(top + share_y * tall))
            cv2.rectangle(image, *box, shaded(glass, gain), cv2.FILLED)
            cv2.rectangle(image, *box, frame, max(1, round(wide / 16)))
        if share_y < 0.7:
            cv2.line(image, (0, round(floor * tall)), (width, round(floor * tall)), frame, max(1, round(tall / 20)))
    return image


def shelves(sampler: RandomSampler, width: int, height: int) -> Image:
    """Shelves full of books, boxes or jars."""
    wood = hued(sampler.uniform(0.2, 0.9), sampler.uniform(0.0, 0.6), sampler.uniform(40.0, 230.0))
    image = plain(width, height, shaded(wood, 0.3))
    count = sampler.integer(2, 7)
    tall, board = height / count, max(2, round(height * sampler.uniform(0.01, 0.03)))
    for shelf in range(count):
        foot, x = round((shelf + 1) * tall), 0.0
        while x < width:
            wide = tall * sampler.uniform(0.06, 0.4)
            top = round(foot - tall * sampler.uniform(0.45, 0.9))
            cv2.rectangle(image, (round(x), top), (round(x + 0.92 * wide), foot), tint(sampler), cv2.FILLED)
            x += max(3.0, wide)
        cv2.rectangle(image, (0, foot - board), (width, foot), wood, cv2.FILLED)
    return image


def screen(sampler: RandomSampler, width: int, height: int) -> Image:
    """A computer's screen: windows with title bars, menus, lists and pictures."""
    image = gradient(width, height, tint(sampler), tint(sampler))
    unit = min(width, height)
    for _ in range(sampler.integer(1, 4)):
        wide, tall = round(width * sampler.uniform(0.3, 0.9)), round(height * sampler.uniform(0.3, 0.9))
        left, top = round(sampler.uniform(0.0, 0.7) * width), round(sampler.uniform(0.0, 0.7) * height)
        content = sampler.choice((page, table, chart, sign))(sampler, max(16, wide), max(16, tall))
        seen = image[top : top + tall, left : left + wide]
        seen[:] = content[: seen.shape[0], : seen.shape[1]]
        bar = max(2, round(unit * 0.04))
        cv2.rectangle(image, (left, top), (left + wide, top + bar), tint(sampler, 60.0), cv2.FILLED)
        write(sampler, image, (left + bar, top + 0.75 * bar), 0.5 * bar, (20.0, 20.0, 20.0), 10)
    if sampler.bernoulli(0.7):
        cv2.rectangle(image, (0, round(0.95 * height)), (width, height), tint(sampler), cv2.FILLED)
    return image


def color_bars(sampler: RandomSampler, width: int, height: int) -> Image:
    """A television test card: bars of pure colors, steps of gray, a circle."""
    image = plain(width, height, (0.0, 0.0, 0.0))
    count, value = sampler.integer(5, 12), sampler.uniform(150.0, 255.0)
    split = round(height * sampler.uniform(0.5, 1.0))
    for index in range(count):
        left, right = round(index * width / count), round((index + 1) * width / count)
        cv2.rectangle(image, (left, 0), (right, split), hued(6.0 * index / count, 1.0, value), cv2.FILLED)
        gray = 255.0 * index / (count - 1)
        cv2.rectangle(image, (left, split), (right, height), (gray, gray, gray), cv2.FILLED)
    if sampler.bernoulli(0.4):
        center, radius = (width // 2, height // 2), round(0.45 * min(width, height))
        cv2.circle(image, center, radius, (250, 250, 250), max(1, radius // 40), cv2.LINE_AA)
        write(sampler, image, (0.4 * width, 0.5 * height), 0.08 * height, (250.0, 250.0, 250.0), 8)
    return image


def arches(sampler: RandomSampler, width: int, height: int) -> Image:
    """Rows of rounded blocks with gaps: teeth, arcades, cushions."""
    image = plain(width, height, tint(sampler, 30.0, 200.0))
    color = hued(sampler.uniform(0.3, 1.0), sampler.uniform(0.0, 0.4), sampler.uniform(160.0, 250.0))
    rows, count, bend = sampler.integer(1, 3), sampler.integer(4, 14), sampler.uniform(-0.25, 0.25)
    tall, wide = height / rows, width / count
    for row in range(rows):
        for index in range(count):
            x = (index + 0.5) * wide
            y = (row + 0.5) * tall + bend * tall * ((2.0 * x / width - 1.0) ** 2 - 0.5)
            half_x, half_y = max(2, round(0.46 * wide)), max(2, round(sampler.uniform(0.3, 0.42) * tall))
            center = round(x), round(y)
            cv2.ellipse(image, center, (half_x, half_y), 0.0, 0.0, 360.0, color, cv2.FILLED, cv2.LINE_AA)
            cv2.ellipse(image, center, (half_x, half_y), 0.0, 0.0, 360.0, shaded(color, 0.6), 1, cv2.LINE_AA)
    return mottled(sampler, image, sampler.uniform(0.1, 0.4), width / 6, height / 6)
