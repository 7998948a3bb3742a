"""Many scenes rendered: what is to be rendered, the renderers, and the job that makes what is missing."""
