"""Recipes: from YAML and back, over the command line, and what is wrong with one."""

from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from pat.lab.training.config import (
    TrainConfig,
    command_line,
    config_text,
    difference,
    load_config,
    parse_config,
    recipes,
    save_config,
)
from pat.networks.configs import PATConfig


def test_written_and_read_back(tmp_path):
    config = TrainConfig(
        photos=(Path("a"), Path("b")), network=PATConfig(dim=8), minutes=3.5, cache=Path("c.npz")
    )
    save_config(config, tmp_path / "c.yaml")
    assert load_config(tmp_path / "c.yaml") == config
    assert parse_config(config_text(TrainConfig())) == TrainConfig()
    assert yaml.safe_load(config_text(config))["network"]["dim"] == 8


@pytest.mark.parametrize("name", recipes())
def test_recipes_of_the_package(name):
    config = load_config(name)
    assert config.out == Path("runs") / name
    assert parse_config(config_text(config)) == config


def test_the_papers_recipes_are_the_papers():
    two, four = load_config("paper-2"), load_config("paper-4")
    assert (two.network, four.network) == (PATConfig(), PATConfig(betas=3, in_channels=1))
    assert two.steps * two.batch == four.steps * four.batch == 80 * 800 * 49
    assert (two.rate, two.schedule, two.loss, two.hw) == (2e-4, "halving", "mse", (32, 96))
    assert two.recording.paper == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("batchs: 4", "c: batchs: unknown key; did you mean 'batch'?"),
        ("recording: {gian: 1}", "c: recording.gian: unknown key; did you mean 'gain'?"),
        ("network: {dimm: 8}", "c: network.dimm: unknown key; did you mean 'dim'?"),
        ("network: {kind: GuidedPAT}", "c: network.kind"),
        ("network: 3", "c: network"),
        ("batch: four", "c: batch"),
        ("batch: 4.5", "c: batch"),
        ("batch: true", "c: batch"),
        ("rate: fast", "c: rate"),
        ("hw: [96]", "c: hw"),
        ("hw: [96, 100]", "c: hw"),
        ("schedule: cosin", "c: schedule: is 'cosin'; did you mean 'cosine'?"),
        ("compile: 1", "c: compile"),
        ("steps: 0", "c: steps"),
        ("minutes: -1", "c: minutes"),
        ("loss: psnr-ssim", "c: loss: is 'psnr-ssim'; did you mean 'psnr'?"),
        ("rectified: -.5", "c: rectified"),
        ("recording: {noise: 60}", "c: recording: noise"),
        ("recording: {miscalibrated: .nan}", "c: recording"),
        ("seed: -1", "c: seed"),
        ("warmup: -5", "c: warmup"),
        ("momenta: [0.9, 1.5]", "c: momenta"),
        ("general_rigs: {near: [0, 2]}", "c: general_rigs: near"),
        ("general_rigs: {resolutions: []}", "c: general_rigs: betas"),
        ("network: {betas: 4}", "c: network.betas"),
        ("rendered: 1.5", "c: rendered"),
        ("rendered: 0.5", "c: rendered"),
        ("rendered_from: a", "c: rendered"),
        ("pairs: 0.5", "c: pairs"),
        ("measured: 0.5", "c: measured"),
        ("measured_from: [a]", "measured_from"),
        ("{rendered: 0.7, rendered_from: a, measured: 0.7, measured_from: [b]}", "1.4"),
        ("attention: -1", "c: attention"),
        ("# to do", "c: the recipe is empty"),
        ("[1, 2]", "[1, 2]"),
        ("a: [", "c: not valid YAML at line 2"),
    ],
)
def test_what_is_wrong_is_named_in_one_line(text, message):
    with pytest.raises(ValueError) as caught:
        parse_config(text, "c")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_recipe_that_is_no_text_is_named(tmp_path):
    recipe = tmp_path / "recipe.yaml"
    recipe.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match=r"recipe[.]yaml: not valid YAML"):
        load_config(recipe)
    with pytest.raises(FileNotFoundError, match="recipe"):  # a name is one of the package
        load_config(recipe.with_suffix(""))


def test_numbers_as_people_write_them():
    config = parse_config("{rate: 8e-4, minutes: inf, steps: 1e5, photos: ~/images, start: null}")
    assert (config.rate, config.minutes, config.steps) == (8e-4, float("inf"), 100_000)
    assert config.photos == (Path.home() / "images",)


def test_the_command_line_goes_over_the_recipe(tmp_path):
    save_config(TrainConfig(batch=6, network=PATConfig(dim=9)), tmp_path / "c.yaml")
    config = command_line(
        [
            str(tmp_path / "c.yaml"),
            "--rate",
            "1e-3",
            "--network.betas",
            "3",
            "--general-rigs.focal-ratio",
            "1",
            "3",
        ]
    )
    assert (config.batch, config.rate, config.network.dim, config.network.betas) == (6, 1e-3, 9, 3)
    assert config.general_rigs.focal_ratio == (1, 3)
    assert command_line(["paper-4", "--network.dim", "8"]).network == PATConfig(betas=3, in_channels=1, dim=8)
    with pytest.raises(FileNotFoundError, match=r"'paper-3'.*'paper-4'"):
        command_line(["paper-3"])


def test_what_makes_another_run():
    config = TrainConfig()
    assert difference(config, replace(config, out=Path("x"), save=3, tensorboard=True)) is None
    assert difference(config, replace(config, seed=1)) == "seed: 0, 1"
