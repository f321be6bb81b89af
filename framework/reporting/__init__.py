"""What a run left behind as one page for the browser: the map to turn, its objects, and how well they were found."""
