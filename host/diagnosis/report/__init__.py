"""The result of a diagnosis: verdict, pictures and page."""
