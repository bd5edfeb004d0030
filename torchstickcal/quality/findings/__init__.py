"""The families of findings, one file each. :mod:`torchstickcal.quality.registry` imports them all."""
