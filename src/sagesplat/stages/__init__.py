"""The stages of a run, one file each: settings, inputs, outputs, and the function that makes them."""
