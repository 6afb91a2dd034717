"""How far exported frames and poses are from the model's own, how long a frame takes and how much memory."""
