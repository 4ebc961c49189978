"""What a frame itself tells, without a reference frame: conductivity, contacts, channels and electrodes."""
