"""Sessions with known truth."""

from torchstickcal.simulate.golf import Noise, golf_session

__all__ = ["Noise", "golf_session"]
