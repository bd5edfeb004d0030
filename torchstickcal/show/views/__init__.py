"""What a calibration can be shown as: figures, a dictionary, a text, HTML. Registered in :data:`torchstickcal.result.VIEWS`."""
