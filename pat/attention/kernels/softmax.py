"""Softmax weights of scores."""

from __future__ import annotations

import math
from inspect import unwrap

import numpy as np
from numba import types
from numba.extending import overload

from arraygeom.runtime.compiled import compiled

from .channels import fill
from .emit import LANES
from .sampling import ONE, interpolate
from .vectors import (
    add,
    exponentials64,
    fma,
    keep_above,
    largest,
    load,
    maximum,
    mul,
    splat,
    store,
    sub,
    total,
    two_to,
    zero,
)


def exponentials(x):
    """exp of a vector of numbers of at most 0; 0 below exp(-87), slightly above the least of float32."""


@overload(exponentials)
def _exponentials(x):
    return (lambda x: exponentials64(x)) if x.scalar == types.float64 else _exponentials32


@unwrap
def _exponentials32(x):
    """Cephes' expf; 1 to 2 units in the last place."""
    low = splat(np.float32(-87.0))
    shift = splat(np.float32(12582912.0))
    y = maximum(low, x)
    n = sub(fma(y, splat(np.float32(1.44269504)), shift), shift)
    y = fma(n, splat(np.float32(-0.693359375)), y)
    y = fma(n, splat(np.float32(2.12194440e-4)), y)
    p = fma(splat(np.float32(1.9875691500e-4)), y, splat(np.float32(1.3981999507e-3)))
    p = fma(p, y, splat(np.float32(8.3334519073e-3)))
    p = fma(p, y, splat(np.float32(4.1665795894e-2)))
    p = fma(p, y, splat(np.float32(1.6666665459e-1)))
    p = fma(p, y, splat(np.float32(5.0000001201e-1)))
    p = add(fma(mul(p, y), y, y), splat(np.float32(1.0)))
    return keep_above(x, low, mul(p, two_to(n)))


@compiled
def find_scores(p, call, here):
    """Compute the scores of pixel p's samples, padded with -inf; written in place."""
    n = here.sample_count[0]
    interpolate(here.by_key, call.geometry, here, here.score)
    if call.biased:
        for j in range(n):
            here.score[j] += call.bias[p * call.geometry.samples + here.index[j]]
    fill(here.score, n, n + LANES, zero(here.score) - np.float32(np.inf))


@compiled
def softmax(n, score, weight):
    """Compute the softmax of n scores.

    Args:
        n: number of scores, 0 or more.
        score: scores, padded with -inf to a multiple of LANES, at least one.
        weight: weights to write; left as they are if all scores are -inf.

    Returns:
        The log of the sum of exponentials; -inf if all scores are.
    """
    best = load(score, 0)
    for j in range(LANES, n, LANES):
        best = maximum(load(score, j), best)
    top = largest(best)
    if top == -np.inf and not math.isnan(_plain_sum(score, n)):
        return top
    mass = exponentiate(n, score, weight, top)
    scale = splat(ONE / mass)
    for j in range(0, n, LANES):
        store(weight, j, mul(load(weight, j), scale))
    return top + math.log(mass)


@compiled
def _plain_sum(numbers, n):
    s = zero(numbers)
    for j in range(n):
        s += numbers[j]
    return s


@compiled
def exponentiate(n, score, weight, top):
    """Compute weight = exp(score - top) in place; scores are padded with -inf. Returns the sum."""
    minus_top = splat(-top)
    mass = splat(zero(score))
    for j in range(0, n, LANES):
        e = exponentials(add(load(score, j), minus_top))
        store(weight, j, e)
        mass = add(mass, e)
    return total(mass)
