"""Many scenes rendered: worker processes, retries, resuming, clusters.

The folder of a job holds `manifest.yaml` (what is rendered, by which versions), `scenes/000012/` (scene 12; that the
folder exists says that it is whole), `scenes.jsonl` (a line for each, with the figures of its check), and
`quarantine/000013/` (why scene 13 was given up, with the log of the process). `.work` is what is under way.
"""
