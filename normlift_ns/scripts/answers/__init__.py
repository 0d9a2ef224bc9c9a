"""What ns-normlift-query and ns-normlift-export show and write of an answer."""
