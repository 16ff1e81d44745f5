//! Large content is written once, into the memory that the receiver reads.
//!
//! ```console
//! $ cargo run --example large_content
//! ```

#![allow(clippy::print_stdout, reason = "an example prints")]

use fipa::{Domain, Performative::Inform};

const LEN: usize = 4 << 20;

#[tokio::main]
async fn main() -> fipa::Result<()> {
    let domain = Domain::from_environment().await?;
    let camera = domain.register("camera").await?;
    let viewer = domain.register("viewer").await?;

    for frame in 1..=3_u8 {
        let image = camera.message(Inform).receiver("viewer");
        let mut loan = camera.loan(image, LEN)?;
        loan.content_mut().fill(frame);
        println!("{}", camera.send_loan(loan).await?);

        // The content stays in shared memory while the letter exists.
        let letter = viewer.receive().await?;
        let bytes = letter
            .message()
            .content()
            .map_or(&[][..], |content| content);
        let right = bytes.iter().filter(|byte| **byte == frame).count();
        println!("frame {frame}: {right} of {LEN} bytes");
    }

    // The limit is transport.shm.max_letter, 64 MiB by default.
    let image = camera.message(Inform).receiver("viewer");
    match camera.loan(image, 1 << 30) {
        Ok(_) => println!("1 GiB is allowed"),
        Err(error) => println!("{error}"),
    }
    domain.close().await;
    Ok(())
}
