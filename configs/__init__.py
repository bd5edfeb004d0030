"""The configurations shipped with torchstickcal, found by name through :func:`torchstickcal.load_config`."""
