"""A small recording that ``torchstickcal sample`` writes out. It is made by ``examples/make_sample.py``."""
