"""What completes colours (`pat.networks.completion`), and the pairs that it and the choice are trained on."""
