"""What completes colours (`pat.networks.completion`), trained on photographs cut into surfaces."""
