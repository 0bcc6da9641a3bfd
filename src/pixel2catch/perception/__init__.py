"""From the RGB stream to the pixel features: image → mask → box → z. It needs the extra `perception`."""
