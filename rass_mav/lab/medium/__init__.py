"""An air that takes time: frames have a length, nodes wait for each other, and frames that overlap are lost."""
