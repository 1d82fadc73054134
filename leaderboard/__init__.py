"""Result records into tables, figures and a page."""
