"""Import of recordings from phones and sensors as RGB-D folders."""
