"""A small recording, as other programs write it. ``examples/make_sample.py`` makes it; ``torchstickcal sample`` writes it out."""
