import jade.core.Agent;
import jade.core.behaviours.CyclicBehaviour;
import jade.domain.FIPANames;
import jade.domain.FIPAAgentManagement.Envelope;
import jade.lang.acl.ACLMessage;

/** Answers each message with an inform of the same content, in the encoding of its argument. */
public class EchoAgent extends Agent {
    @Override
    protected void setup() {
        Object[] arguments = getArguments();
        final String codec = arguments != null && arguments.length > 0 ? (String) arguments[0] : null;
        addBehaviour(new CyclicBehaviour(this) {
            @Override
            public void action() {
                ACLMessage message = myAgent.receive();
                if (message == null) {
                    block();
                    return;
                }
                if (message.getPerformative() == ACLMessage.FAILURE) {
                    System.err.println("failure: " + message.getContent());
                    return;
                }
                ACLMessage reply = message.createReply();
                reply.setPerformative(ACLMessage.INFORM);
                if (message.hasByteSequenceContent()) {
                    reply.setByteSequenceContent(message.getByteSequenceContent());
                } else {
                    reply.setContent(message.getContent());
                }
                reply.setDefaultEnvelope();
                if (codec != null) {
                    reply.getEnvelope().setAclRepresentation(codec);
                }
                reply.getEnvelope().setPayloadEncoding("UTF-8");
                myAgent.send(reply);
            }
        });
    }
}
