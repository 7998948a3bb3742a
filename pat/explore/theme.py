"""The explorer's colours, light and dark: variables that the page, the widgets and the figures' texts share."""

from __future__ import annotations

NEUTRAL = "#808890"
"""Texts and grids inside figures: legible on both backgrounds."""
PAGE = """
:root { --pat-page: #f6f7f9; --pat-card: #ffffff; --pat-ink: #1c2127; --pat-soft: #5d6670; --pat-line: #d5dae0;
        --pat-accent: #0a66c2; color-scheme: light; }
@media (prefers-color-scheme: dark) { :root:not([data-theme=light]) {
        --pat-page: #14171a; --pat-card: #1d2125; --pat-ink: #e8eaed; --pat-soft: #9aa3ad; --pat-line: #363c43;
        --pat-accent: #6cb2ff; color-scheme: dark; } }
:root[data-theme=dark] { --pat-page: #14171a; --pat-card: #1d2125; --pat-ink: #e8eaed; --pat-soft: #9aa3ad;
        --pat-line: #363c43; --pat-accent: #6cb2ff; color-scheme: dark; }
html, body { background: var(--pat-page); color: var(--pat-ink); margin: 0; font-family: system-ui, sans-serif; }
"""
WIDGET = """
:host { color: var(--pat-ink, inherit); font-size: 13px; }
label, .bk-slider-title, .bk-input-group label { color: var(--pat-soft, inherit); }
.bk-slider-value { color: var(--pat-ink, inherit); }
.bk-input, select, input { background: var(--pat-card, #fff); color: var(--pat-ink, #000);
        border: 1px solid var(--pat-line, #ccc); border-radius: 6px; }
.bk-btn, a.bk-btn { background: var(--pat-card, #fff) !important; color: var(--pat-ink, #000) !important;
        border: 1px solid var(--pat-line, #ccc) !important; border-radius: 6px; box-shadow: none !important; }
.bk-btn.bk-active { background: var(--pat-accent, #06c) !important; color: var(--pat-card, #fff) !important; }
.noUi-target { background: var(--pat-line, #ddd); box-shadow: none; border: 0; }
.noUi-connect, .noUi-handle { background: var(--pat-accent, #06c) !important; border: 0; box-shadow: none; }
:host(.card) { border: 1px solid var(--pat-line, #ccc) !important; box-shadow: none !important; border-radius: 6px; }
.card-header { background: transparent !important; color: var(--pat-ink, inherit) !important; }
.card-header-row, .card-title, .card-title * { color: var(--pat-ink, inherit) !important; }
"""
TEXT = {"color": "var(--pat-ink, inherit)", "font-size": "13px", "line-height": "1.5"}
CARD = {"background": "var(--pat-card, #fff)", "border": "1px solid var(--pat-line, #ddd)", "border-radius": "10px"}
TOGGLE = """
const root = document.documentElement;
const dark = root.dataset.theme ? root.dataset.theme == 'dark' : matchMedia('(prefers-color-scheme: dark)').matches;
root.dataset.theme = dark ? 'light' : 'dark';
"""
HEADING = (
    '<h1 style="font-size:1.35rem;margin:0">Where a pixel may match</h1>'
    '<p style="margin:.2rem 0 0;color:var(--pat-soft,#666)">Click a pixel of alpha: geometry leaves it a short segment '
    "in every other camera, and the marks show how its samples compare; move the rig and see what happens.</p>"
)
