"""What a run left behind as one page for the browser: the map to turn, its objects, how they were found and how well."""
