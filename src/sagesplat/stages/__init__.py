"""What each stage of a run does: its settings, inputs and outputs, and the call that makes them."""
