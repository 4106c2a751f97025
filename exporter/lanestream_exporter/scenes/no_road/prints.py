"""Patterns with text: pages, tables, charts, signs, screens, keyboards."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from lanestream.road.view import Image
from lanestream_exporter.scenes.no_road.colors import BgrColor, gradient, hued, plain, shaded, tint
from lanestream_exporter.scenes.no_road.patterns import blocks
from lanestream_exporter.scenes.random_sampler import RandomSampler

_LETTERS: Final = "aabcdeeefghiijklmnnoopqrrssttuuvwxyzAEIKMNORSTW0123456789.,:-%"
_FONTS: Final = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_COMPLEX, cv2.FONT_HERSHEY_TRIPLEX)
_FONT_HEIGHT: Final = 22.0  # of a capital letter at scale 1, pixels


def page(sampler: RandomSampler, width: int, height: int) -> Image:
    """Returns a page of text in one to three columns, with headings and pictures."""
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
    """Returns a table or form with ruled lines and short entries."""
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
    """Returns a chart with axes, grid, labels and curves, bars, dots or sectors."""
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
    """Returns a sign, a poster or a logo: a few large shapes and some large letters."""
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


def screen(sampler: RandomSampler, width: int, height: int) -> Image:
    """Returns a computer's screen: windows with title bars, menus, lists and pictures."""
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


def keyboard(sampler: RandomSampler, width: int, height: int) -> Image:
    """Returns keys of a computer or of a piano."""
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
    blocks(sampler, image, (size * sampler.uniform(0.9, 1.3), size), size * sampler.uniform(0.08, 0.25), None, color)
    ink = (240.0, 240.0, 240.0) if sum(color) < 330 else (20.0, 20.0, 20.0)
    for y in np.arange(0.6 * size, height, size).tolist():
        for x in np.arange(0.4 * size, width, size).tolist():
            write(sampler, image, (x, y), size / 4, ink, 1)
    return image


def color_bars(sampler: RandomSampler, width: int, height: int) -> Image:
    """Returns a television test card: bars of pure colors, steps of gray, a circle."""
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


def write(
    sampler: RandomSampler, image: Image, at: tuple[float, float], size: float, color: BgrColor, count: int
) -> None:
    """Writes `count` random letters, `size` pixels high, from the left end of their foot line."""
    picks = sampler.rng.integers(len(_LETTERS), size=count).tolist()
    spaces = sampler.rng.random(count) < 0.16
    text = "".join(" " if space else _LETTERS[pick] for pick, space in zip(picks, spaces, strict=True))
    place, thick = (round(at[0]), round(at[1])), max(1, round(size / sampler.uniform(7.0, 14.0)))
    cv2.putText(image, text, place, sampler.choice(_FONTS), size / _FONT_HEIGHT, color, thick, cv2.LINE_AA)
