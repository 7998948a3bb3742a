"""Attention supervised by geometry: the loss against its definition, its minimum, and what it leaves out."""

from __future__ import annotations

import torch

from arraygeom import Segments
from pat.attention.scores import Compared
from pat.lab.training.attention_loss import UNSEEN, attention_loss, target_of

HW, SAMPLES = (4, 12), 7


def rows(batch=1, dtype=torch.float64) -> Segments:
    """Each pixel's segment: the row of beta from 6 pixels to its left to itself, on an image wide enough."""
    y, x = torch.meshgrid(torch.arange(HW[0]), torch.arange(HW[1]), indexing="ij")
    end = torch.stack([x + 6, y], -1).to(dtype).expand(batch, *HW, 2)
    return Segments(end - end.new_tensor([6.0, 0.0]), end, torch.ones(batch, *HW, dtype=torch.bool))


def compared(query, key, batch=1) -> Compared:
    return Compared(query, key, key, rows(batch, query.dtype), SAMPLES, "bilinear")


def random(seed=0):
    g = torch.Generator().manual_seed(seed)
    query = torch.randn(1, 3, *HW, dtype=torch.float64, generator=g, requires_grad=True)
    key = torch.randn(1, 3, HW[0], HW[1] + 6, dtype=torch.float64, generator=g, requires_grad=True)
    share = torch.rand(1, *HW, dtype=torch.float64, generator=g) * 6
    position = rows().start + torch.stack([share, torch.zeros_like(share)], -1)
    return query, key, position, share


def test_the_loss_is_the_cross_entropy_of_gathered_weights():
    query, key, position, share = random()
    visible = torch.rand(1, *HW, generator=torch.Generator().manual_seed(1)) < 0.6
    columns = torch.arange(HW[1])[:, None] + torch.arange(SAMPLES)
    log_weight = torch.einsum("bdhw,bdhwl->bhwl", query, key[..., columns]).log_softmax(-1)
    number = torch.arange(SAMPLES)
    target = (1 - (number - share[..., None]).abs()).clamp(min=0)  # 1 - u and u at the two neighbours
    seen, hidden = -(target * log_weight).sum(-1)[visible].mean(), -log_weight.mean(-1)[~visible].mean()
    expected = seen + UNSEEN * hidden
    found = attention_loss([compared(query, key)], [position], [visible], stride=1)
    torch.testing.assert_close(found, expected)
    ours, theirs = (torch.autograd.grad(v, [query, key]) for v in (found, expected))
    torch.testing.assert_close(ours, theirs)


def test_a_query_like_its_true_key_alone_has_no_loss():
    key = torch.eye(HW[1] + 6, dtype=torch.float64)[None, :, None].expand(1, -1, HW[0], -1)
    query = 50 * key[..., 3 : 3 + HW[1]]
    position = rows().start + torch.tensor([3.0, 0.0])
    visible = torch.ones(1, *HW, dtype=torch.bool)
    assert attention_loss([compared(query, key)], [position], [visible]) < 1e-12
    assert attention_loss([compared(query, key)], [position + torch.tensor([1.0, 0.0])], [visible]) > 40


def test_what_is_unknown_or_off_the_segment_does_not_count():
    query, key, position, _ = random()
    visible = torch.ones(1, *HW, dtype=torch.bool)
    unknown = attention_loss([compared(query, key)], [torch.zeros_like(position)], [~visible], stride=1)
    beside = attention_loss(
        [compared(query, key)], [position + torch.tensor([0.0, 2.0])], [visible], stride=1
    )
    beyond = attention_loss(
        [compared(query, key)], [rows().end + torch.tensor([3.0, 0.0])], [visible], stride=1
    )
    assert unknown == beside == beyond == 0


def test_the_samples_around_a_position_on_a_slanted_segment():
    one = torch.ones(1, 1, 1, dtype=torch.bool)
    segments = Segments(torch.tensor([[[[1.0, 1.0]]]]), torch.tensor([[[[9.0, 5.0]]]]), one)
    target = target_of(segments, 5, torch.tensor([[[[6.0, 3.5]]]]))
    torch.testing.assert_close(target.first[0, 0, 0], torch.tensor([5.0, 3.0]))
    torch.testing.assert_close(target.second[0, 0, 0], torch.tensor([7.0, 4.0]))
    torch.testing.assert_close(target.share, torch.full((1, 1, 1), 0.5))
    assert target.on_segment.all()


def test_a_segment_of_one_sample_has_a_target():
    query, key, _, _ = random()
    start = rows().start
    one = Compared(query, key, key, Segments(start, start, rows().valid), 1, "bilinear")
    loss = attention_loss([one], [start], [torch.ones(1, *HW, dtype=torch.bool)], stride=1)
    torch.testing.assert_close(loss, torch.zeros_like(loss))


def test_the_loss_of_a_moving_rig_is_that_of_its_differences():
    """Both parts follow the positions: the true score and the sum over the segment."""
    query, key, position, _ = random()
    visible = torch.rand(1, *HW, generator=torch.Generator().manual_seed(1)) < 0.6
    start, end = (v.detach() + 0.3 for v in (rows().start, rows().end))

    def loss(start, end, query, key):
        segments = Segments(start, end, rows().valid)
        one = Compared(query, key, key, segments, SAMPLES, "bilinear")
        return attention_loss([one], [position + 0.37], [visible], stride=1)

    numbers = [v.requires_grad_() for v in (start, end)]
    assert torch.autograd.gradcheck(loss, (*numbers, query, key))
    still = attention_loss([compared(query, key)], [position], [visible], stride=1)
    moved = [v.detach().requires_grad_() for v in (rows().start, rows().end)]
    by_formula = Compared(query, key, key, Segments(*moved, rows().valid), SAMPLES, "bilinear")
    torch.testing.assert_close(attention_loss([by_formula], [position], [visible], stride=1), still)
